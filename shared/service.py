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
from collections.abc import Callable
from typing import Any, ClassVar

from shared.bus import Bus, Received, Socket
from shared.clock import ClockOffset, now_ns
from shared.config import ServiceConfig
from shared.connections import raise_file_limit
from shared.endpoints import is_loopback, split_endpoint, with_key
from shared.errors import UserError
from shared.keys import Guest, Peer, own_key, refusal, save_guests
from shared.logs import LOG, RateLimit, configure
from shared.metrics import Metrics
from shared.wire.codec import BadMessage
from shared.wire.control import (
    AllowedKeys,
    FlushNow,
    Heartbeat,
    HeartbeatSeen,
    SessionInput,
    StartSession,
    StopSession,
    UseLips,
)
from shared.wire.message import Message
from shared.wire.session import ChooseExpressiveness, Done, Error, ErrorCode, Express

HEARTBEAT_S = 0.5
TICK_S = 0.01
TURN_S = 0.05  # for one socket's messages, before other sockets, ticks and heartbeats
UNANSWERED_S = 10.0  # without an answer to heartbeats it is worth asking why
DRAIN_LIMIT_S = 5.0
PARENT_VARIABLE = "_KOUXING_SUPERVISOR"  # its process number; the underscore: no setting

Handler = Callable[[Any, Peer], None]


class Service:
    """What all services share; subclasses add their sockets and handlers.

    A subclass says its role and the endpoints it needs, fills in ``endpoints`` with those it
    provides, calls ``register`` for its own sockets, and overrides ``start_session``,
    ``stop_session``, ``flush_session``, ``use_lips``, ``express``, ``choose_expressiveness``,
    ``session_inputs``, ``on_tick``, ``on_drain``.
    """

    name: ClassVar[str]
    role: ClassVar[str]  # worker: placed in sessions; observer: takes part in all of them
    needs: ClassVar[tuple[str, ...]] = ()  # names of the endpoints it must be told
    client_roles: ClassVar[tuple[str, ...]] = ()  # of its key, beside that of the service

    def __init__(self, config: ServiceConfig, *, control: bool = True) -> None:
        self.config = config
        self.instance = config.instance or f"{self.name}-{secrets.token_hex(3)}"
        self.roles = (f"service:{self.name}", *self.client_roles)
        self.key = None if config.insecure else own_key(self.name, self.roles)
        self.control_endpoint = with_key(config.control, self.key.control if self.key else "")
        self.bus = Bus(self.key)
        self.metrics = Metrics()
        self.clock_offset = ClockOffset()
        self.endpoints: dict[str, str] = {}  # what it provides, by name
        self.language = ""  # of the phones that it recognises
        self.frame_rate_hz = 0.0  # of the FAP frames that it makes
        self.delay_ms = 0.0  # how much later than its sound it makes a FAP frame
        self.lips = ""  # the lip model that it uses until a client chooses one
        self.warnings = RateLimit()
        self._poller = self.bus.poller()
        self._handlers: dict[Socket, dict[type[Message], Handler]] = {}
        self._paused: set[Socket] = set()
        self._stop_requested = False
        self._beat_due_s = 0.0
        self._answered_s = time.monotonic()
        self._tick_due_s = 0.0
        self.control: Socket | None = None
        if control:
            self.control = self.bus.connect_dealer(self.control_endpoint)
            self.register(
                self.control,
                {
                    HeartbeatSeen: self._on_heartbeat_seen,
                    AllowedKeys: self._on_allowed_keys,
                    StartSession: self._on_start,
                    StopSession: lambda message, _: self.stop_session(message.session),
                    FlushNow: lambda message, _: self.flush_session(message.session),
                    UseLips: lambda message, _: self.use_lips(message.session, message.lips),
                    Express: lambda message, _: self.express(message),
                    ChooseExpressiveness: lambda message, _: self.choose_expressiveness(message),
                    Error: self._on_error,
                    Done: lambda _message, _sender: None,
                },
            )

    # --- what a subclass provides ----------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Serve a session; return False to call ``session_started`` later."""
        return True

    def stop_session(self, session: str) -> None:
        """Forget a session, if it is known."""

    def flush_session(self, session: str) -> None:
        """Drop audio of a session that is not yet shown."""

    def use_lips(self, session: str, lips: str) -> None:
        """Let another lip model move the mouth of a session, if that is made here."""

    def express(self, message: Express) -> None:
        """Let the face of a session show expressions, if it is made here."""

    def choose_expressiveness(self, message: ChooseExpressiveness) -> None:
        """Let the mouth of a session move more or less, if it is made here."""

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

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        """Send the heartbeat to control."""
        if self.control is not None:
            self.control.send(heartbeat)

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

    def session_started(self, start: StartSession) -> None:
        """Tell control that this service serves a session now."""
        if self.control is not None:
            self.control.send(Done(session=start.session, request=start.request))

    def warn(self, reason: str, text: str, session: str = "") -> None:
        """Count a problem, and log it at a limited rate."""
        self.metrics.count(f"dropped_{reason}")
        if self.warnings.allows(reason):
            LOG.warning(text, extra={"session": session})

    def step(self, timeout_s: float) -> None:
        """Handle what has arrived, waiting up to the timeout, then tick."""
        for socket in self.wait(timeout_s):
            handlers = self._handlers.get(socket)
            if handlers is None:  # closed by a handler in this round
                continue
            turn_ends_s = time.monotonic() + TURN_S
            for received in socket.receive():
                self._dispatch(socket, handlers, received)
                if time.monotonic() > turn_ends_s:
                    break
        now_s = time.monotonic()
        if now_s >= self._tick_due_s:
            self._tick_due_s = now_s + TICK_S
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
        gc.collect()
        gc.freeze()  # a full collection would stop the loop for 100 ms
        self.announce_ready()
        while not self.stopping:
            self.step(TICK_S)
        self.drain()

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
        deadline_s = time.monotonic() + DRAIN_LIMIT_S
        self._stop_requested = True
        while not self.on_drain() and time.monotonic() < deadline_s:
            self.step(TICK_S)
        self.on_stopped()
        self._beat()
        self.bus.close()
        LOG.info("stopped")

    # --- inside ----------------------------------------------------------------------------------

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
            self.warn("unexpected", f"dropped a {message.kind} message: not expected here")
            if received.sender.address:
                text = f"{message.kind} is not understood on this socket"
                socket.send(Error(code=ErrorCode.BAD_MESSAGE, text=text), to=received.sender)
            return
        self.metrics.count(f"in_{message.kind.replace('-', '_')}")
        try:
            handler(message, received.sender)
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE):
                raise
            self.warn("files", f"{message.kind}: {error.strerror}", message.session)

    def _beat(self) -> None:
        self.on_heartbeat_due(
            Heartbeat(
                service=self.name,
                instance=self.instance,
                role=self.role,
                needs=list(self.needs),
                language=self.language,
                frame_rate_hz=self.frame_rate_hz,
                delay_ms=self.delay_ms,
                lips=self.lips,
                state="draining" if self._stop_requested else "ready",
                sent_ns=now_ns(),
                endpoints=self.endpoints,
                metrics={
                    **self.metrics.snapshot(time.monotonic()),
                    "cpu_s": time.process_time(),
                    "clock_offset_ms": -self.clock_offset.offset_ms,
                },
                sessions=self.session_inputs(),
            )
        )

    def _ask_why_unanswered(self, now_s: float) -> None:
        if self.control is not None and now_s - self._answered_s > UNANSWERED_S:
            self._answered_s = now_s
            threading.Thread(target=self._warn_if_refused, daemon=True).start()

    def _warn_if_refused(self) -> None:
        """Say what to do if control does not accept the key; it waits, on sockets of its own."""
        with contextlib.suppress(UserError), Bus(self.key) as bus:
            if bus.is_refused(self.control_endpoint):
                LOG.warning(refusal(self.control_endpoint, self.name, self.roles))

    def _on_heartbeat_seen(self, seen: HeartbeatSeen, _sender: Peer) -> None:
        self._answered_s = time.monotonic()
        self.clock_offset.update(seen.sent_ns, seen.received_ns, seen.replied_ns, now_ns())

    def _on_allowed_keys(self, allowed: AllowedKeys, _sender: Peer) -> None:
        guests = {key: Guest(each.name, tuple(each.roles)) for key, each in allowed.keys.items()}
        save_guests(guests)
        if self.bus.zap is not None:
            self.bus.zap.refresh()

    def _on_start(self, start: StartSession, _sender: Peer) -> None:
        if self._stop_requested:
            return
        try:
            if self.start_session(start):
                self.session_started(start)
        except UserError as error:
            self.warn("start", str(error), start.session)
            if self.control is not None:
                self.control.send(
                    Error(session=start.session, code=ErrorCode.TIMEOUT, text=str(error))
                )

    def _on_error(self, error: Error, _sender: Peer) -> None:
        self.warn(error.code, f"control: {error.text}", error.session)


def run_service(make: Callable[[], Service], section: str, log_level: str) -> int:
    """Make a service and run it to its end; return the exit status.

    A user's mistake gives one line and status 2, an internal error a traceback and status 1.
    """
    configure(section, log_level)
    raise_file_limit()
    try:
        service = make()
    except UserError as error:
        print(f"{section}: {error}", file=sys.stderr)
        return 2
    try:
        service.run()
    except UserError as error:  # while running it is no mistake of the user: crash and restart
        raise RuntimeError(str(error)) from error
    return 0
