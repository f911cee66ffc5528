"""The one loop that every service runs.

Start-up (configuration, sockets, load, registration) -> "ready" -> one poller, control first ->
SIGTERM or SIGINT sets a flag -> drain with a deadline -> exit 0. A second signal forces the end.
Heartbeats are sent from this loop, so control sees a hung loop as a lost service.
"""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar

from kouxing.shared.bus import Bus, Received, Socket
from kouxing.shared.clock import ClockOffset, StallDetector, now_ns
from kouxing.shared.config import ServiceConfig
from kouxing.shared.connections import raise_file_limit
from kouxing.shared.endpoints import is_loopback, split_endpoint, with_key
from kouxing.shared.errors import UserError
from kouxing.shared.keys import Guest, Peer, own_key, refusal, save_guests
from kouxing.shared.logs import LOG, RateLimit, configure
from kouxing.shared.metrics import BusyShare, Metrics, give_back_memory, keep_one_arena, memory_mb
from kouxing.shared.prometheus import MetricsServer
from kouxing.shared.wire.codec import BadMessage
from kouxing.shared.wire.control import (
    AllowedKey,
    Event,
    EventName,
    Heartbeat,
    HeartbeatReply,
    SessionInput,
    SessionStarted,
    StartSession,
    StopSession,
)
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import Error, ErrorCode, FlushSession, SessionFacts

HEARTBEAT_S = 0.25
SESSIONS_A_BEAT = 16  # of a worker, in turn: a heartbeat costs the same however many it serves
STOOD_STILL_S = 0.8  # without a heartbeat: control may have given its sessions to others
ANSWER_LIMIT_S = 0.5  # for control to say so
LOAD_PERIOD_S = 2.0
TICK_S = 0.01
TURN_S = 0.05  # for one socket's messages, before other sockets, ticks and heartbeats
UNANSWERED_S = 10.0  # without an answer to heartbeats it is worth asking why
DRAIN_LIMIT_S = 5.0
HAND_OVER_S = 1.5  # of it, for other workers to take the sessions of one that stops
ALIVE_S = 5.0  # without a tick the loop hangs
ENDS_S = 15.0  # without one the process ends when somebody asks for its health
PARENT_VARIABLE = "_KOUXING_SUPERVISOR"  # its process number; the underscore: no setting
PULSE_VARIABLE = "_KOUXING_PULSE"  # file descriptor of a pipe that tells it of each heartbeat

Handler = Callable[[Any, Peer], None]


class Service:
    """What all services share; subclasses add their sockets and handlers.

    A subclass says its role and the endpoints it needs, fills in ``endpoints`` with those it
    provides, calls ``register`` for its own sockets, and overrides ``control_handlers``,
    ``start_session``, ``stop_session``, ``flush_session``, ``served_sessions``,
    ``session_inputs``, ``gauges``, ``on_tick``, ``on_drain``.
    """

    name: ClassVar[str]
    role: ClassVar[str]  # worker: placed in sessions; observer: takes part in all of them
    needs: ClassVar[tuple[str, ...]] = ()  # names of the endpoints it must be told
    client_roles: ClassVar[tuple[str, ...]] = ()  # of its key, beside that of the service

    def __init__(
        self, config: ServiceConfig, *, control: bool = True, extra_connections: int = 0
    ) -> None:
        self.config = config
        self.instance = config.instance or f"{self.name}-{secrets.token_hex(3)}"
        self.roles = (f"service:{self.name}", *self.client_roles)
        self.key = None if config.insecure else own_key(self.name, self.roles)
        self.control_endpoint = with_key(config.control, self.key.control if self.key else "")
        self.bus = Bus(self.key, extra_connections=extra_connections)
        self.metrics = Metrics()
        self.stall = StallDetector(time.monotonic())
        self.clock_offset = ClockOffset()
        self.endpoints: dict[str, str] = {}  # what it provides, by name
        self.facts = SessionFacts()  # about the sessions that it serves
        self.warnings = RateLimit()
        self._poller = self.bus.poller()
        self._handlers: dict[Socket, dict[type[Message], Handler]] = {}
        self._paused: set[Socket] = set()
        self._stop_requested = False
        self._hands_over_until_s = 0.0
        self._beat_due_s = 0.0
        self._beat_sent_s = time.monotonic()
        self._num_named = 0  # sessions in the heartbeats before
        self._sent_ns = self._answered_ns = 0  # newest heartbeat, and the newest that was answered
        self._answered_s = time.monotonic()
        self._control_instance = ""  # that answered last
        self._tick_due_s = 0.0
        self._busy = BusyShare(LOAD_PERIOD_S, time.monotonic())
        self.session_at_work = ""  # whose message is being handled; a crash is its
        self.at_each_step: set[Callable[[], None]] = set()
        self.control = self._connect_to_control() if control else None

    # --- what a subclass provides ----------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Serve a session; return False to call ``session_started`` later."""
        return True

    def stop_session(self, session: str) -> None:
        """Forget a session, if it is known."""

    def flush_session(self, session: str) -> None:
        """Drop audio of a session that is not yet shown."""

    def served_sessions(self) -> Iterable[StartSession]:
        """Return the sessions that a restarted control learns from this service."""
        return ()

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages; subclasses add theirs."""
        return {
            HeartbeatReply: self._on_heartbeat_reply,
            StartSession: self._on_start,
            StopSession: lambda message, _: self.stop_session(message.session),
            FlushSession: lambda message, _: self.flush_session(message.session),
            Error: self._on_error,
        }

    def on_start(self) -> None:
        """Begin what needs the loop; called once, before the service says that it is ready."""

    def wait(self, timeout_s: float) -> list[Socket]:
        """Wait up to the timeout for messages; return the sockets that have some."""
        return self._poller.wait(timeout_s)

    def on_tick(self, now_s: float) -> None:
        """Do what is due; called about every 10 ms."""

    def on_drain(self) -> bool:
        """Finish work in progress; called again until it returns True or the time is up."""
        return True

    def on_stopped(self) -> None:
        """Save what can be saved after draining, finished or not."""

    def session_inputs(self) -> dict[str, SessionInput]:
        """Return the sessions it takes part in and how far their input has come."""
        return {}

    def gauges(self) -> dict[str, float]:
        """Return more figures of this moment, by name, for heartbeats and Prometheus."""
        return {}

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        """Send the heartbeat to control."""
        self.tell_control(heartbeat)

    # --- for subclasses --------------------------------------------------------------------------

    def register(self, socket: Socket, handlers: dict[type[Message], Handler]) -> None:
        """Handle messages that arrive on a socket, by their type."""
        self._handlers[socket] = handlers
        self._poller.add(socket)

    def unregister(self, socket: Socket) -> None:
        """Stop handling and close a socket."""
        self._poller.remove(socket)
        del self._handlers[socket]
        self.bus.drop(socket)

    def pause(self, socket: Socket, *, paused: bool) -> None:
        """Leave a socket's messages in its queue for now, so that its senders must wait."""
        if paused and socket not in self._paused:
            self._paused.add(socket)
            self._poller.remove(socket)
        elif not paused and socket in self._paused:
            self._paused.remove(socket)
            self._poller.add(socket)

    def session_started(self, start: StartSession, media_time: int = 0) -> None:
        """Tell control that this service serves a session now.

        ``media_time`` is up to where its phones are final here, in samples at 16 kHz.
        """
        self.tell_control(
            SessionStarted(session=start.session, request=start.request, media_time=media_time)
        )

    def publish_event(self, name: EventName, session: str, detail: str) -> None:
        """Let control publish an event about a session."""
        self.tell_control(Event(session=session, name=name, detail=detail[:2000]))

    def tell_control(self, message: Message) -> None:
        """Send a message to control, unless this is control."""
        if self.control is not None:
            self.control.send(message)

    def warn(self, reason: str, text: str, session: str = "") -> None:
        """Count a problem, and log it at a limited rate."""
        self.metrics.count(f"dropped_{reason}")
        if self.warnings.allows(reason):
            LOG.warning(text, extra={"session": session})

    def step(self, timeout_s: float) -> None:
        """Handle what has arrived, waiting up to the timeout, then tick."""
        begin_s = time.monotonic()
        self._busy.waits(begin_s)
        self.stall.restart(begin_s)
        sockets = self.wait(timeout_s)
        now_s = time.monotonic()
        self._busy.works(now_s)
        self.stall.check(now_s, expected_s=timeout_s)
        self._ask_what_changed()
        for socket in sockets:
            handlers = self._handlers.get(socket)
            if handlers is None:  # closed by a handler in this round
                continue
            turn_ends_s = time.monotonic() + TURN_S
            for received in socket.receive():
                self._dispatch(socket, handlers, received)
                if socket in self._paused or time.monotonic() > turn_ends_s:
                    break
        self._ask_what_changed()  # it may have stood still meanwhile, too
        now_s = time.monotonic()
        if now_s >= self._tick_due_s:
            self._tick_due_s = now_s + TICK_S
            for call in tuple(self.at_each_step):
                call()
            self.on_tick(now_s)
        self.beat_if_due()

    def beat_if_due(self) -> None:
        """Send a heartbeat if one is due; also called in the midst of long work."""
        now_s = time.monotonic()
        if now_s >= self._beat_due_s:
            self._beat_due_s = now_s + HEARTBEAT_S
            self._beat()
            self._ask_why_unanswered(now_s)

    @property
    def stopping(self) -> bool:
        """Whether the loop is to end: by request, or because the supervisor is gone."""
        parent = os.environ.get(PARENT_VARIABLE)
        return self._stop_requested or (parent is not None and os.getppid() != int(parent))

    def run(self) -> None:
        """Run until a signal asks for the end, then drain."""
        self._install_signals()
        self.on_start()
        server = self._serve_metrics()
        gc.collect()
        gc.freeze()  # a full collection would stop the loop for 100 ms
        give_back_memory()  # what loading took
        self.announce_ready()
        while not self.stopping:
            self.step(TICK_S)
        self.drain()
        if server is not None:
            server.close()

    @property
    def hands_over(self) -> bool:
        """Whether other workers may still take the sessions of this one, which stops."""
        return time.monotonic() < self._hands_over_until_s

    def announce_ready(self) -> None:
        """Register with control and log it."""
        bound = [each for each in self.endpoints.values() if each.startswith("tcp://")]
        if self.config.insecure and not all(
            is_loopback(split_endpoint(each, "")[0]) for each in bound
        ):
            LOG.warning("insecure = true: whoever reaches %s may do anything", " ".join(bound))
        self._beat()
        LOG.info("ready %s", " ".join(f"{k}={v}" for k, v in self.endpoints.items()))

    def drain(self) -> None:
        """Finish work in progress within the deadline and close every socket."""
        begin_s = time.monotonic()
        self._hands_over_until_s = begin_s + HAND_OVER_S
        self._stop_requested = True
        self._beat(whole=True)  # control gives the sessions to others while they still go on here
        while not self.on_drain() and time.monotonic() < begin_s + DRAIN_LIMIT_S:
            self.step(TICK_S)
        self.on_stopped()
        self._beat()
        self.bus.close()
        LOG.info("stopped")

    # --- inside ----------------------------------------------------------------------------------

    def _connect_to_control(self) -> Socket:
        socket = self.bus.connect_dealer(self.control_endpoint)
        self.register(socket, self.control_handlers())
        return socket

    def _ask_what_changed(self) -> None:
        """Learn, before more is published, what control has decided if this stood still."""
        if time.monotonic() - self._beat_sent_s <= STOOD_STILL_S:
            return
        self._beat(whole=True)
        if self.control is None:
            return
        end_s = time.monotonic() + ANSWER_LIMIT_S  # it may be away
        while self._answered_ns < self._sent_ns and (left_s := end_s - time.monotonic()) > 0:
            self.control.wait(left_s)
            for received in self.control.receive():
                self._dispatch(self.control, self._handlers[self.control], received)

    def _install_signals(self) -> None:
        def on_signal(number: int, _frame: object) -> None:
            if self._stop_requested:
                os._exit(128 + number)
            self._stop_requested = True

        signal.signal(signal.SIGTERM, on_signal)
        signal.signal(signal.SIGINT, on_signal)

    def _dispatch(
        self, socket: Socket, handlers: dict[type[Message], Handler], received: Received
    ) -> None:
        message = received.message
        if isinstance(message, BadMessage):
            self.warn(message.reason, f"dropped a message: {message}")
            if received.sender.address:
                answer = Error(
                    version=message.version,  # so that a client of another version can read it
                    code=ErrorCode.BAD_MESSAGE,
                    text=str(message)[:2000],
                )
                socket.send(answer, to=received.sender)
            return
        handler = handlers.get(type(message))
        if handler is None:
            text = f"dropped a {message.kind} message: not expected here"
            self.warn("unexpected", text, message.session)
            if received.sender.address:
                text = f"{message.kind} is not understood on this socket"
                socket.send(Error(code=ErrorCode.BAD_MESSAGE, text=text), to=received.sender)
            return
        self.metrics.count(f"in_{message.kind.replace('-', '_')}")
        self.session_at_work = message.session
        try:
            handler(message, received.sender)
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            self.warn("files", f"{message.kind}: {error.strerror}", message.session)
        self.session_at_work = ""

    def _serve_metrics(self) -> MetricsServer | None:
        if not self.config.metrics_port:
            return None
        self._tick_due_s = time.monotonic()
        return MetricsServer(
            self.config.metrics_host,
            self.config.metrics_port,
            self.metrics,
            self.name,
            is_alive=self.check_health,
        )

    def check_health(self) -> bool:
        """Return whether the loop runs; after long, end: whoever asks may not start it again."""
        stood_s = time.monotonic() - self._tick_due_s
        if stood_s > ENDS_S:
            LOG.critical("the loop hangs")
            os._exit(1)
        return stood_s < ALIVE_S

    def _beat(self, *, whole: bool = False) -> None:
        """Send a heartbeat, with the whole of the sessions or with some in turn."""
        self._beat_sent_s, self._sent_ns = time.monotonic(), now_ns()
        _tell_parent()
        sessions, load = self.session_inputs(), self._busy.share(time.monotonic())
        for name, value in {"sessions": len(sessions), "load": load, **self.gauges()}.items():
            self.metrics.set(name, value)
        self.on_heartbeat_due(
            Heartbeat(
                service=self.name,
                instance=self.instance,
                role=self.role,
                needs=list(self.needs),
                facts=self.facts,
                state="draining" if self._stop_requested else "ready",
                sent_ns=self._sent_ns,
                endpoints=self.endpoints,
                load=load,
                metrics={
                    **self.metrics.snapshot(time.monotonic()),
                    "cpu_s": time.process_time(),
                    "memory_mb": memory_mb(),
                    "clock_offset_ms": -self.clock_offset.offset_ms,
                },
                sessions=self._named_sessions(sessions, whole=whole),
            )
        )

    def _named_sessions(
        self, inputs: dict[str, SessionInput], *, whole: bool
    ) -> dict[str, SessionInput]:
        if whole or self.role != "worker" or len(inputs) <= SESSIONS_A_BEAT:
            return inputs
        names = list(inputs)
        begin = self._num_named % len(names)
        self._num_named = begin + SESSIONS_A_BEAT
        return {name: inputs[name] for name in (names + names)[begin : self._num_named]}

    def _ask_why_unanswered(self, now_s: float) -> None:
        if self.control is not None and now_s - self._answered_s > UNANSWERED_S:
            self._answered_s = now_s
            if not self.control.can_send:  # something else was at its address, or its keys differed
                self.unregister(self.control)
                self.control = self._connect_to_control()
            threading.Thread(target=self._warn_if_refused, daemon=True).start()

    def _warn_if_refused(self) -> None:
        """Say what to do if control does not accept the key; it waits, on sockets of its own."""
        with contextlib.suppress(UserError), Bus(self.key) as bus:
            if bus.is_refused(self.control_endpoint):
                LOG.warning(refusal(self.control_endpoint, self.name, self.roles))

    def _on_heartbeat_reply(self, reply: HeartbeatReply, _sender: Peer) -> None:
        self._answered_s = time.monotonic()
        self._answered_ns = reply.sent_ns
        self.clock_offset.update(reply.sent_ns, reply.received_ns, reply.replied_ns, now_ns())
        has_restarted = self._control_instance not in ("", reply.control)
        self._control_instance = reply.control
        if reply.keys is not None:
            self._allow(reply.keys)
        if has_restarted:
            for start in self.served_sessions():
                self.tell_control(
                    SessionStarted(session=start.session, request=start.request, start=start)
                )

    def _allow(self, keys: Mapping[str, AllowedKey]) -> None:
        """Let these keys connect, and no others."""
        guests = {key: Guest(allowed.name, tuple(allowed.roles)) for key, allowed in keys.items()}
        if self.bus.zap is None:
            return
        try:
            save_guests(guests)
            self.bus.zap.refresh()
        except UserError as error:  # it counts as long as this process runs
            LOG.error("the allowed keys are not kept: %s", error)
            self.bus.zap.allow(guests)

    def _on_start(self, start: StartSession, _sender: Peer) -> None:
        if self._stop_requested:
            return
        try:
            if self.start_session(start):
                self.session_started(start)
        except UserError as error:
            self.warn("start", str(error), start.session)
            self.publish_event(EventName.ERROR, start.session, f"{ErrorCode.TIMEOUT}: {error}")

    def _on_error(self, error: Error, _sender: Peer) -> None:
        self.warn(error.code, f"control: {error.text}", error.session)


def _tell_parent() -> None:
    """Tell whoever started this process that its loop runs, if he wants to know."""
    if pulse := os.environ.get(PULSE_VARIABLE):
        with contextlib.suppress(OSError):  # he has not read for hours, or is gone
            os.write(int(pulse), b".")


def run_service(make: Callable[[], Service], section: str, log_level: str) -> int:
    """Make a service and run it to its end; return the exit status.

    A user's mistake gives one line and status 2, an internal error a traceback and status 1.
    """
    configure(section, log_level)
    keep_one_arena()
    raise_file_limit()
    try:
        service = make()
    except UserError as error:
        print(f"{section}: {error}", file=sys.stderr)
        return 2
    try:
        service.run()
    except Exception:  # a UserError too: while running it is no mistake of the user
        LOG.critical("internal error", exc_info=True, extra={"session": service.session_at_work})
        return 1
    return 0
