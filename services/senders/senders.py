"""Sends a face to any number of programs, each at its own delay, beside the caller's own loop."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.senders.connections import Connection, connect
from kouxing.services.senders.face import Face
from kouxing.services.senders.playout import Playout
from kouxing.services.senders.target import Target
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import REST_RATE_HZ, RestingFace

MAX_SENDERS = 16
STALL_S = 1.0  # a face goes to rest after so long without frames
FADE_S = 0.3  # time it takes to get there
RATE_WINDOW_S = 2.0
MAX_COUNTED = 1000  # frames of that

Faps = NDArray[np.float32]
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderState:
    """What a sender does at the moment."""

    target: str
    """Its address, as it was given."""
    delay_ms: float
    """How much later than they could be frames are sent."""
    contents: str
    """What it sends, in words."""
    rate_hz: float
    """Frames that left in the last 2 s, a second."""
    problem: str
    """What keeps frames from the target, in words; empty: nothing that is known."""


@dataclass(slots=True, eq=False)
class _Sender:
    connection: Connection
    task: asyncio.Task[None]
    delay_s: float
    waiting: deque[tuple[float, Face]] = field(default_factory=deque)  # best time and frame
    timer: asyncio.TimerHandle | None = None
    sent_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_COUNTED))
    reported: str = ""


class Senders:
    """Sends frames to targets, in a thread of its own; its methods may be called from any other.

    Frames are those of one session at a time. While none come, targets see a face at rest.

    Parameters
    ----------
    idle_motion_seed
        Of the face at rest; 0: it stands still.
    report
        Called with a target's address and problem when that changes; empty: it has passed.
    """

    def __init__(self, idle_motion_seed: int, report: Callable[[str, str], None]) -> None:
        self._report = report
        self._senders: dict[str, _Sender] = {}
        self._rest = RestingFace(idle_motion_seed)
        self._playout = Playout()
        self._shown = np.zeros(NUM_FAPS, np.float32)  # newest frame of a session,
        self._shown_s = time.monotonic() - STALL_S - FADE_S  # when it came,
        self._session_time_s = -STALL_S - FADE_S  # and its media time
        self._timer: asyncio.TimerHandle | None = None  # of the next tick, while there are senders
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def start(self, target: Target) -> None:
        """Begin to send to a target; one of the same address goes on as it is.

        Raises
        ------
        UserError
            If there are too many.
        """
        self._call(lambda: self._start(target))

    def stop(self, url: str) -> None:
        """Send to a target no longer, if it is one."""
        self._call(lambda: self._stop(url))

    def delay(self, delay_s: float) -> None:
        """Send to all programs so much later from here on, whatever their addresses say."""
        self._call(lambda: self._delay(delay_s))

    def accept(self, session_time_s: float, faps: Faps) -> None:
        """Show a frame (68,) of the session; it may wait, but nothing waits for it."""
        self._loop.call_soon_threadsafe(self._accept, session_time_s, faps, time.monotonic())

    def states(self) -> list[SenderState]:
        """Return what each sender does, in the order in which they started."""
        return self._call(self._states)

    def close(self) -> None:
        """Stop all, and end the thread."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join()

    # --- in the thread ---------------------------------------------------------------------------

    def _run(self) -> None:
        self._loop.run_forever()
        self._loop.run_until_complete(self._end())
        self._loop.close()

    async def _end(self) -> None:
        tasks = [sender.task for sender in self._senders.values()]
        for url in list(self._senders):
            self._stop(url)
        await asyncio.gather(*tasks, return_exceptions=True)

    def _call(self, work: Callable[[], Result]) -> Result:
        async def run() -> Result:
            return work()

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result()

    def _start(self, target: Target) -> None:
        if target.url in self._senders:
            return
        if len(self._senders) >= MAX_SENDERS:
            raise UserError(f"{MAX_SENDERS} programs are sent to already; stop one first")
        connection = connect(target)
        task = self._loop.create_task(connection.run())
        self._senders[target.url] = _Sender(connection, task, target.delay_s)
        if self._timer is None:
            self._tick()

    def _stop(self, url: str) -> None:
        sender = self._senders.pop(url, None)
        if sender is not None:
            sender.task.cancel()
            if sender.timer is not None:
                sender.timer.cancel()

    def _delay(self, delay_s: float) -> None:
        for sender in self._senders.values():
            sender.delay_s = delay_s
            if sender.timer is not None:
                sender.timer.cancel()
            self._send_due(sender)

    def _states(self) -> list[SenderState]:
        since_s = self._loop.time() - RATE_WINDOW_S
        states = []
        for url, sender in self._senders.items():
            while sender.sent_s and sender.sent_s[0] < since_s:
                sender.sent_s.popleft()
            states.append(
                SenderState(
                    target=url,
                    delay_ms=round(1e3 * sender.delay_s, 3),
                    contents=sender.connection.target.contents,
                    rate_hz=len(sender.sent_s) / RATE_WINDOW_S,
                    problem=sender.connection.problem,
                )
            )
        return states

    def _accept(self, session_time_s: float, faps: Faps, came_s: float) -> None:
        self._shown, self._shown_s, self._session_time_s = faps, came_s, session_time_s
        self._show(Face(faps, session_time_s), self._playout.best_s(session_time_s, came_s))

    def _tick(self) -> None:
        """Show the face at rest while no frames come, and report what has changed."""
        if not self._senders:
            self._timer = None
            return
        self._timer = self._loop.call_later(1.0 / REST_RATE_HZ, self._tick)
        now_s = time.monotonic()
        stalled_s = now_s - self._shown_s - STALL_S
        if stalled_s > 0:
            share = max(0.0, 1.0 - stalled_s / FADE_S)
            rest = self._rest.at(now_s)
            time_s = self._session_time_s + now_s - self._shown_s
            self._show(Face(rest + np.float32(share) * (self._shown - rest), time_s), now_s)
        for url, sender in self._senders.items():
            problem = sender.connection.problem
            if problem != sender.reported:
                sender.reported = problem
                self._report(url, problem)

    def _show(self, face: Face, best_s: float) -> None:
        for sender in self._senders.values():
            sender.waiting.append((best_s, face))
            if sender.timer is None:
                self._send_due(sender)

    def _send_due(self, sender: _Sender) -> None:
        sender.timer = None
        while sender.waiting:
            best_s, face = sender.waiting[0]
            due_s = best_s + sender.delay_s
            if due_s > time.monotonic():
                sender.timer = self._loop.call_at(due_s, self._send_due, sender)
                return
            sender.waiting.popleft()
            if sender.connection.send(face):
                sender.sent_s.append(time.monotonic())
