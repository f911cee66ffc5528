"""The loop that every service runs: startup, main loop, shutdown.

A service sleeps until a message arrives or periodic work is due (``on_tick``). SIGTERM or SIGINT
ends the main loop; then the service finishes its work within a deadline. A second signal ends
the process immediately. The loop sends the heartbeats, so control detects a hung loop.
"""

import gc
import math
import os
import secrets
import signal
import threading
import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, ClassVar

from kouxing_client.connection_check import explain_unreachable
from kouxing_client.keys import Key
from kouxing_client.messages import Message, SessionFacts

from kouxing.shared.clock import ClockOffset, StallDetector, now_ns
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.monitoring.metrics import LOAD_PERIOD_S, LoadMeter, memory_mb, trim_heap
from kouxing.shared.network.bus import Bus, ProbeResult
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service import parent_process
from kouxing.shared.service.message_loop import Handler, MessageLoop
from kouxing.shared.service.service_kind import ServiceKind
from kouxing.shared.settings.config import ServiceConfig
from kouxing.shared.settings.endpoints import is_loopback, split_endpoint, with_key
from kouxing.shared.settings.keys import Grant, load_key, rejection_hint, save_grants
from kouxing.shared.wire.control import AllowedKey, Heartbeat, HeartbeatReply, SessionProgress
from kouxing.shared.wire.session import Error

if TYPE_CHECKING:
    from kouxing.shared.monitoring.prometheus import MetricsServer

TICK_S = 0.01  # minimum time between ticks
FOLLOW_UP_S = 0.03  # time between two ticks if a message arrived within ``TICK_S``
HEARTBEAT_S = 0.25  # interval between heartbeats of a worker with sessions
IDLE_HEARTBEAT_S = 1.0  # interval of other services, whose loss interrupts no session
SNAPSHOT_S = 1.0  # interval between computations of rates and percentiles for heartbeats
SESSIONS_PER_HEARTBEAT = 16  # limit for a worker, so that a heartbeat's cost does not grow
RESYNC_AFTER_S = 0.55  # delay of a heartbeat after which control may have moved the sessions
REPLY_TIMEOUT_S = 0.5
NO_REPLY_S = 10.0  # after this time without a reply from control, the reason is logged
FIRST_REPLY_S = 3.0  # limit at startup
DRAIN_TIMEOUT_S = 5.0
HAND_OVER_S = 3.0  # time for control to move the sessions of a stopping worker
MAX_LATE_S = 5.0  # delay of a heartbeat above which a service is not healthy
EXIT_AFTER_S = 15.0  # delay of a heartbeat above which a health check ends the process
_BUILD = version("kouxing")


class Service(MessageLoop):
    """Base class of all services.

    A subclass sets ``kind``, fills in ``endpoints`` and ``facts``, registers handlers for its own
    sockets, and overrides the methods of the first section below.
    """

    kind: ClassVar[ServiceKind]
    connects_to_control: ClassVar[bool] = True  # False: it is control

    def __init__(self, config: ServiceConfig, *, extra_connections: int = 0) -> None:
        self.config = config
        self.name = self.kind.name
        self.instance = config.instance or f"{self.name}-{secrets.token_hex(3)}"
        self.has_new_key = False  # True: the process must restart
        self.key = None if config.insecure else self._load_key()
        self.control_endpoint = with_key(config.control, self.key.control if self.key else "")
        super().__init__(Bus(self.key, extra_connections=extra_connections))
        self.stall_detector = StallDetector(time.monotonic())
        self.clock_offset = ClockOffset()
        self.endpoints: dict[str, str] = {}  # endpoints that it provides, by name
        self.facts = SessionFacts()  # facts about the sessions of this service
        self.languages: list[str] = []  # additional languages that its sessions may choose
        self.lip_models: list[str] = []  # lip models that its sessions may choose
        self.tick_callbacks: set[Callable[[], float]] = set()  # as `on_tick`
        self._exit_requested = False
        self._hand_over_end_s = 0.0
        self._last_tick_s = self._tick_due_s = 0.0
        self._heartbeat_due_s = time.monotonic()
        self._next_reported = 0  # index of the first session in the next heartbeat
        self._snapshot: dict[str, float] = {}  # newest rates and percentiles
        self._snapshot_due_s = -math.inf
        self._sent_ns = self._replied_ns = 0  # newest heartbeat, newest heartbeat with a reply
        self._last_reply_s = time.monotonic() - NO_REPLY_S + FIRST_REPLY_S
        self._control_instance = ""
        self.load_meter = LoadMeter(LOAD_PERIOD_S, time.monotonic())
        self._metrics_server: MetricsServer | None = None
        self.control = self._connect_to_control() if self.connects_to_control else None

    # --- for subclasses to override ------------------------------------------------------------

    def on_startup(self) -> None:
        """Prepare the main loop; called once, before the service registers."""

    def on_tick(self, now_s: float) -> float:
        """Do the work that is due; return when more work is due.

        The service also calls this after messages and other events, but at most every ``TICK_S``.
        """
        return math.inf

    def on_drain(self) -> bool:
        """Finish the work in progress; called until it returns True or the time is up."""
        return True

    def on_shutdown(self) -> None:
        """Save what can be saved, after draining."""

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages; subclasses add theirs."""
        return {HeartbeatReply: self.on_heartbeat_reply, Error: self.on_error}

    def session_progress(self) -> dict[str, SessionProgress]:
        """Return the input progress of each session."""
        return {}

    def on_control_restart(self) -> None:
        """Handle a restart of control, which then has only the data of heartbeats."""

    def gauges(self) -> dict[str, float]:
        """Return additional figures by name, for heartbeats and Prometheus."""
        return {}

    def deliver_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat to control."""
        self.send_to_control(heartbeat)

    # --- for subclasses to call ----------------------------------------------------------------

    def send_to_control(self, message: Message) -> None:
        """Send a message to control; do nothing in control itself."""
        if self.control is not None:
            self.control.send(message)

    @property
    def is_handing_over(self) -> bool:
        """Whether control may still move sessions of this stopping worker."""
        return time.monotonic() < self._hand_over_end_s

    # --- life cycle ----------------------------------------------------------------------------

    def run(self) -> None:
        """Run after ``startup()``, until a signal arrives or the supervisor ends."""
        self._install_signal_handlers()
        gc.freeze()  # a full collection would stop the loop for 100 ms
        gc.enable()  # see services.process
        trim_heap()
        while not self.should_exit:
            self.step(IDLE_HEARTBEAT_S)
        self.shutdown()

    def startup(self) -> None:
        """Register with control. Raises ``UserError`` if the metrics' port cannot be bound."""
        self.on_startup()
        self._heartbeat_due_s = time.monotonic()  # the startup may have taken long
        if self.config.metrics:
            from kouxing.shared.monitoring.prometheus import MetricsServer  # noqa: PLC0415 - slow, rarely used

            host, port = split_endpoint(f"tcp://{self.config.metrics}", "metrics")
            self._metrics_server = MetricsServer(
                host.strip("[]"), int(port), self.metrics, self.name, is_alive=self.check_or_exit
            )
        self._warn_if_open_to_others()
        self._warn_if_closed_to_others()
        self._send_heartbeat()
        if self.control is None:
            self._log_ready()
        else:
            LOG.info("waiting for control at %s", self.config.control)

    def shutdown(self) -> None:
        """Finish the work in progress within the deadline, and close all sockets."""
        start_s = time.monotonic()
        self._hand_over_end_s = start_s + HAND_OVER_S
        self._exit_requested = True
        self._send_heartbeat(all_sessions=True)  # control moves the sessions, which continue here
        while not self.on_drain() and time.monotonic() < start_s + DRAIN_TIMEOUT_S:
            self.step(TICK_S)
        self.on_shutdown()
        self._send_heartbeat()
        self.bus.close()
        if self._metrics_server is not None:
            self._metrics_server.close()
        LOG.info("stopped")

    @property
    def should_exit(self) -> bool:
        """Whether the main loop ends: a signal arrived, or the supervisor is gone."""
        return self._exit_requested or parent_process.has_exited()

    def step(self, timeout_s: float) -> None:
        """Wait up to the timeout for messages, handle them, then tick."""
        start_s = time.monotonic()
        due_s = min(self._tick_due_s, self._heartbeat_due_s)
        timeout_s = max(0.0, min(timeout_s, due_s - start_s))
        self.load_meter.start_waiting(start_s)
        self.stall_detector.restart(start_s)
        sockets = self.wait(timeout_s)
        now_s = time.monotonic()
        self.load_meter.start_working(now_s)
        self.stall_detector.check(now_s, expected_s=timeout_s)
        self.resync_with_control()
        for socket in sockets:
            self.handle_messages(socket)
        self.resync_with_control()
        now_s = time.monotonic()
        if sockets or self.waker.clear():
            is_early = now_s < self._last_tick_s + TICK_S
            next_tick_s = self._last_tick_s + FOLLOW_UP_S if is_early else now_s
            self._tick_due_s = min(self._tick_due_s, next_tick_s)
        if now_s >= self._tick_due_s:
            self._last_tick_s = now_s
            due_s = min((callback() for callback in tuple(self.tick_callbacks)), default=math.inf)
            self._tick_due_s = max(now_s + TICK_S, min(due_s, self.on_tick(now_s)))
        self.send_heartbeat_if_due()

    def check_or_exit(self) -> bool:
        """Return whether the loop runs; end the process if it has hung for long.

        The program that checks the health may not be able to restart this process.
        """
        late_s = time.monotonic() - self._heartbeat_due_s
        if late_s > EXIT_AFTER_S:
            LOG.critical("the loop hangs")
            os._exit(1)
        return late_s < MAX_LATE_S

    def _install_signal_handlers(self) -> None:
        def on_signal(number: int, _frame: object) -> None:
            if self._exit_requested:
                os._exit(128 + number)
            self._exit_requested = True
            self.waker.wake()

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)

    def _warn_if_open_to_others(self) -> None:
        if not self.config.insecure:
            return
        bound = [endpoint for endpoint in self.endpoints.values() if endpoint.startswith("tcp://")]
        if not all(is_loopback(split_endpoint(endpoint, "")[0]) for endpoint in bound):
            LOG.warning("insecure = true: anyone who can reach %s has full access", " ".join(bound))

    def _warn_if_closed_to_others(self) -> None:
        if is_loopback(split_endpoint(self.config.control, "")[0]):
            return
        for key, endpoint in self.endpoints.items():
            address = endpoint.partition(" ")[0]
            if address.startswith("tcp://") and is_loopback(split_endpoint(address, "")[0]):
                LOG.warning(
                    "other hosts cannot connect to %s at %s; to change this, set this key to"
                    " tcp://0.0.0.0:PORT",
                    key,
                    address,
                )

    # --- control -------------------------------------------------------------------------------

    def on_error(self, error: Error, _sender: Peer) -> None:
        """Log another service's error."""
        self.warn(error.code, error.text, error.session)

    def send_heartbeat_if_due(self) -> None:
        """Send a heartbeat if it is due. Long work calls this regularly."""
        now_s = time.monotonic()
        if now_s >= self._heartbeat_due_s:
            self._send_heartbeat()
            self._check_replies(now_s)

    def resync_with_control(self) -> None:
        """After a stall, wait for control's decisions before publishing anything else."""
        if time.monotonic() <= self._heartbeat_due_s + RESYNC_AFTER_S:
            return
        self._send_heartbeat(all_sessions=True)
        if self.control is None:
            return
        end_s = time.monotonic() + REPLY_TIMEOUT_S
        while self._replied_ns != self._sent_ns and (left_s := end_s - time.monotonic()) > 0:
            self.control.wait(left_s)
            self.handle_messages(self.control)

    def _load_key(self) -> Key:
        control = self.config.control if self.connects_to_control else ""
        return load_key(self.name, self.kind.key_roles, control=control)

    def _connect_to_control(self) -> Socket:
        socket = self.bus.connect_dealer(self.control_endpoint)
        self.register(socket, self.control_handlers())
        return socket

    def _send_heartbeat(self, *, all_sessions: bool = False) -> None:
        now_s = time.monotonic()
        self._sent_ns = now_ns()
        sessions, load = self.session_progress(), self.load_meter.load(now_s)
        is_idle = not sessions or self.kind.role != "worker"
        self._heartbeat_due_s = now_s + (IDLE_HEARTBEAT_S if is_idle else HEARTBEAT_S)
        parent_process.write_heartbeat(is_idle=is_idle)
        self.metrics.values |= {"sessions": len(sessions), "load": load, **self.gauges()}
        if now_s >= self._snapshot_due_s:
            self._snapshot_due_s = now_s + SNAPSHOT_S
            self._snapshot = {**self.metrics.snapshot(now_s), "memory_mb": memory_mb()}
        self.deliver_heartbeat(
            Heartbeat(
                service=self.name,
                instance=self.instance,
                role=self.kind.role,
                needs=list(self.kind.needs),
                facts=self.facts,
                languages=self.languages,
                lip_models=self.lip_models,
                state="draining" if self._exit_requested else "ready",
                sent_ns=self._sent_ns,
                endpoints=self.endpoints,
                build=_BUILD,
                load=load,
                metrics={
                    **self._snapshot,
                    **self.metrics.values,
                    "cpu_s": time.process_time(),
                    "clock_offset_ms": -self.clock_offset.offset_ms,
                },
                sessions=sessions if all_sessions else self._next_sessions(sessions),
            )
        )

    def _next_sessions(self, sessions: dict[str, SessionProgress]) -> dict[str, SessionProgress]:
        """Return the sessions for the next heartbeat, only some of them if a worker has many."""
        if self.kind.role != "worker" or len(sessions) <= SESSIONS_PER_HEARTBEAT:
            return sessions
        names = list(sessions)
        start = self._next_reported % len(names)
        self._next_reported = start + SESSIONS_PER_HEARTBEAT
        return {name: sessions[name] for name in (names + names)[start : self._next_reported]}

    def _check_replies(self, now_s: float) -> None:
        """If control does not reply, reconnect if necessary, and look for the reason."""
        if self.control is not None and now_s - self._last_reply_s > NO_REPLY_S:
            self._last_reply_s = now_s
            if not self.control.can_send:  # another program was at the address, or other keys
                self.unregister(self.control)
                self.control = self._connect_to_control()
            threading.Thread(target=self._warn_about_control, daemon=True).start()

    def _warn_about_control(self) -> None:
        """Log why control does not answer, with the remedy. Runs on a thread, because it waits."""
        host, port = split_endpoint(self.config.control, "control")
        if reason := explain_unreachable(host, port, is_zeromq=True):
            LOG.warning("waiting for control at %s: %s", self.config.control, reason)
            return
        try:
            with Bus(self.key) as bus:
                if bus.probe(self.control_endpoint) is not ProbeResult.REJECTED:
                    return
            if self.key is not None and self._load_key() != self.key:
                LOG.warning("restarting with a new key")
                self.has_new_key = self._exit_requested = True
                return
            LOG.warning(rejection_hint(self.control_endpoint, self.name, self.kind.key_roles))
        except UserError as error:  # such as a new key that does not fit control's key
            LOG.warning("waiting for control at %s: %s", self.config.control, error)

    def _log_ready(self) -> None:
        LOG.info("ready %s", " ".join(f"{k}={v}" for k, v in self.endpoints.items()))

    def on_heartbeat_reply(self, reply: HeartbeatReply, _sender: Peer) -> None:
        """Measure the clock offset, and detect a restart of control."""
        self._last_reply_s = time.monotonic()
        self._replied_ns = reply.sent_ns
        self.clock_offset.update(reply.sent_ns, reply.received_ns, reply.replied_ns, now_ns())
        if not self._control_instance:
            self._log_ready()
        has_restarted = self._control_instance not in ("", reply.control_instance)
        self._control_instance = reply.control_instance
        if reply.keys is not None:
            self._allow_keys(reply.keys)
        if has_restarted:
            self.on_control_restart()

    def _allow_keys(self, keys: Mapping[str, AllowedKey]) -> None:
        """Accept only connections with these keys."""
        if self.bus.zap is None:
            return
        grants = {key: Grant(allowed.name, tuple(allowed.roles)) for key, allowed in keys.items()}
        try:
            save_grants(grants)
            self.bus.zap.refresh()
        except UserError as error:
            LOG.error("cannot save the allowed keys; they apply until this process ends: %s", error)
            self.bus.zap.allow(grants)
