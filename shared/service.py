"""The one loop that every service runs.

Start-up (configuration, sockets, load, registration) -> "ready" -> one poller, control first ->
SIGTERM or SIGINT sets a flag -> drain with a deadline -> exit 0. A second signal forces the end.
Heartbeats leave from this loop, so a hung loop is seen as a lost service.
"""

from __future__ import annotations

import gc
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable
from typing import Any, ClassVar

from shared.bus import Bus, Received, Socket
from shared.clock import ClockOffset, now_ns
from shared.codec import BadMessage
from shared.config import Config
from shared.errors import UserError
from shared.logs import LOG, RateLimit, configure
from shared.messages import (
    Done,
    Error,
    FlushNow,
    Heartbeat,
    HeartbeatSeen,
    Message,
    StartSession,
    StopSession,
)
from shared.metrics import Metrics

HEARTBEAT_S = 0.5
TICK_S = 0.01
TURN_S = 0.05  # for one socket's messages, before others, ticks and heartbeats get theirs
DRAIN_LIMIT_S = 5.0
PARENT_VARIABLE = "KOUXING_SUPERVISOR"  # process number of the supervisor that started this one

Handler = Callable[[Any, bytes], None]


class Service:
    """What the five services share; subclasses add their sockets and handlers.

    A subclass calls ``listen`` for its own sockets, and overrides ``start_session``,
    ``stop_session``, ``flush_session``, ``on_tick``, ``on_drain``.
    """

    name: ClassVar[str]

    def __init__(self, config: Config, *, control: bool = True) -> None:
        self.config = config
        self.instance = config.instance or f"{self.name}-{secrets.token_hex(3)}"
        self.bus = Bus()
        self.metrics = Metrics()
        self.clock_offset = ClockOffset()
        self.endpoints: dict[str, str] = {}
        self.warnings = RateLimit()
        self._poller = self.bus.poller()
        self._handlers: dict[Socket, dict[type[Message], Handler]] = {}
        self._paused: set[Socket] = set()
        self._stop_requested = False
        self._beat_due_s = 0.0
        self._tick_due_s = 0.0
        self.control: Socket | None = None
        if control:
            self.control = self.bus.connect_dealer(config.control)
            self.listen(
                self.control,
                {
                    HeartbeatSeen: self._on_heartbeat_seen,
                    StartSession: self._on_start,
                    StopSession: lambda message, _: self.stop_session(message.session),
                    FlushNow: lambda message, _: self.flush_session(message.session),
                    Error: self._on_error,
                    Done: lambda _message, _sender: None,
                },
            )

    # --- what a subclass provides ----------------------------------------------------------------

    def start_session(self, start: StartSession) -> bool:
        """Serve a session; return False if ``session_started`` will be called later."""
        return True

    def stop_session(self, session: str) -> None:
        """Let go of a session, if it is known."""

    def flush_session(self, session: str) -> None:
        """Drop what is queued for a session."""

    def on_tick(self, now_s: float) -> None:
        """Do what time asks for; called about every 10 ms."""

    def on_drain(self) -> bool:
        """Finish what is under way; called again until it returns True or the time is up."""
        return True

    def on_stopped(self) -> None:
        """Save what can be saved when the time to drain is over."""

    def idle_s(self) -> dict[str, float]:
        """Return for how long each session has had no input, for control's idle limit."""
        return {}

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        """Send the heartbeat to control."""
        if self.control is not None:
            self.control.send(heartbeat)

    # --- for subclasses --------------------------------------------------------------------------

    def listen(self, socket: Socket, handlers: dict[type[Message], Handler]) -> None:
        """Handle messages that arrive on a socket, by their type."""
        self._handlers[socket] = handlers
        self._poller.add(socket)

    def unlisten(self, socket: Socket) -> None:
        """Stop handling and close a socket."""
        self._poller.remove(socket)
        del self._handlers[socket]
        self.bus.drop(socket)

    def pause(self, socket: Socket, *, paused: bool) -> None:
        """Leave a socket's messages in its queue for now, so that its senders feel it."""
        if paused and socket not in self._paused:
            self._paused.add(socket)
            self._poller.remove(socket)
        elif not paused and socket in self._paused:
            self._paused.remove(socket)
            self._poller.add(socket)

    def session_started(self, start: StartSession) -> None:
        """Tell control that a session is served now."""
        if self.control is not None:
            self.control.send(Done(session=start.session, request=start.request))

    def warn(self, reason: str, text: str, session: str = "") -> None:
        """Count a problem, and log it at a limited rate."""
        self.metrics.count(f"dropped_{reason}")
        if self.warnings.allows(reason):
            LOG.warning(text, extra={"session": session})

    @property
    def file_descriptors(self) -> list[int]:
        """For an event loop that calls ``step`` when one becomes readable."""
        return [socket.file_descriptor for socket in self._handlers]

    def step(self, timeout_s: float) -> None:
        """Handle what has arrived, waiting up to the timeout, then tick."""
        for socket in self._poller.wait(timeout_s):
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
        """Say that this loop is alive; for the midst of long work, too."""
        now_s = time.monotonic()
        if now_s >= self._beat_due_s:
            self._beat_due_s = now_s + HEARTBEAT_S
            self._beat()

    def request_stop(self) -> None:
        """End the loop after what is under way."""
        self._stop_requested = True

    @property
    def stopping(self) -> bool:
        """Whether the end was asked for; the supervisor's death counts as asking."""
        parent = os.environ.get(PARENT_VARIABLE)
        return self._stop_requested or (parent is not None and os.getppid() != int(parent))

    def run(self) -> None:
        """Run until a signal asks for the end, then drain."""
        self._install_signals()
        gc.collect()
        gc.freeze()  # a full collection would stop the loop for 100 ms
        self.announce_ready()
        while not self.stopping:
            self.step(TICK_S)
        self.drain()

    def announce_ready(self) -> None:
        """Register with control and say so."""
        self._beat()
        LOG.info("ready %s", " ".join(f"{k}={v}" for k, v in self.endpoints.items()))

    def drain(self) -> None:
        """Finish what is under way within the deadline and close every socket."""
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
            if received.sender:
                socket.send(Error(code="bad-message", text=str(message)[:2000]), to=received.sender)
            return
        handler = handlers.get(type(message))
        if handler is None:
            self.warn("unexpected", f"dropped a {message.kind} message: not expected here")
            if received.sender:
                text = f"{message.kind} is not understood on this socket"
                socket.send(Error(code="bad-message", text=text), to=received.sender)
            return
        self.metrics.count(f"in_{message.kind}")
        handler(message, received.sender)

    def _beat(self) -> None:
        self.on_heartbeat_due(
            Heartbeat(
                service=self.name,
                instance=self.instance,
                state="draining" if self._stop_requested else "ready",
                sent_ns=now_ns(),
                endpoints=self.endpoints,
                metrics={
                    **self.metrics.snapshot(time.monotonic()),
                    "cpu_s": time.process_time(),
                    "clock_offset_ms": -self.clock_offset.offset_ms,
                },
                idle_s=self.idle_s(),
            )
        )

    def _on_heartbeat_seen(self, seen: HeartbeatSeen, _sender: bytes) -> None:
        self.clock_offset.update(seen.sent_ns, seen.received_ns, seen.replied_ns, now_ns())

    def _on_start(self, start: StartSession, _sender: bytes) -> None:
        if self._stop_requested:
            return
        try:
            if self.start_session(start):
                self.session_started(start)
        except UserError as error:
            self.warn("start", str(error), start.session)
            if self.control is not None:
                self.control.send(Error(session=start.session, code="timeout", text=str(error)))

    def _on_error(self, error: Error, _sender: bytes) -> None:
        self.warn(error.code, f"control says: {error.text}", error.session)


def run_service(make: Callable[[], Service], section: str, log_level: str) -> int:
    """Make a service and run it to its end; return the exit status.

    A user's mistake is one line and status 2, an internal error a traceback and status 1.
    """
    configure(section, log_level)
    try:
        service = make()
    except UserError as error:
        print(f"{section}: {error}", file=sys.stderr)
        return 2
    try:
        service.run()
    except UserError as error:  # not the user's: nothing was typed; the supervisor starts it again
        raise RuntimeError(str(error)) from error
    return 0
