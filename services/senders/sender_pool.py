"""Sends a face to several programs, each with its own delay, from a separate thread."""

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from kouxing.services.senders.connection import TargetConnection
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.protocols import change_delay, make_connection
from kouxing.services.senders.target import Target
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import FADE_S, RESTING_RATE_HZ, STALL_S, RestingFace

MAX_SENDERS = 16
RATE_WINDOW_S = 2.0
WINDOW_S = 2.0  # period in which the smallest network delay counts
PAUSE_S = 0.5  # a frame that is this much later than other frames follows a pause
MAX_COUNTED = 1000  # frames in the window

Faps = Floats
TargetKey = tuple[str, str, int]  # ``Target.key``
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True, kw_only=True)
class SenderState:
    """The state of a sender for display."""

    target: str  # its ``Target.url``
    delay_ms: float  # additional delay of each frame
    contents: str  # description of the data
    rate_hz: float  # frames per second, over the last 2 s
    problem: str  # why frames do not reach the target; empty if no problem is known


@dataclass(slots=True, eq=False)
class _Sender:
    connection: TargetConnection
    task: asyncio.Task[None]
    queue: deque[tuple[float, FaceFrame]] = field(default_factory=deque)  # with earliest times
    timer: asyncio.TimerHandle | None = None
    sent_s: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_COUNTED))
    reported_problem: str = ""


class PlayoutClock:
    """Removes network jitter from frame times.

    The frame with the smallest network delay defines the earliest possible arrival of all other
    frames. A frame is due at its earliest arrival plus the target's delay. Without a delay, it is
    due on arrival; a delay above the jitter removes the jitter. Clocks drift, so only recent
    frames count. The measurement restarts when media time stops, jumps back or is late.
    """

    def __init__(self) -> None:
        self._newest_time_s = -math.inf
        self._window_end_s = -math.inf
        self._min_delay_s = self._previous_min_delay_s = math.inf  # this window, previous window

    def earliest_s(self, time_s: float, now_s: float) -> float:
        """Return the earliest time at which a frame that has just arrived could have arrived.

        ``time_s`` is its media time. ``now_s`` and the result are times of a monotonic clock.
        """
        delay_s = now_s - time_s
        min_delay_s = min(self._min_delay_s, self._previous_min_delay_s)
        if time_s <= self._newest_time_s or delay_s > min_delay_s + PAUSE_S:
            self._min_delay_s, self._window_end_s = math.inf, -math.inf
        if now_s > self._window_end_s:
            self._previous_min_delay_s, self._min_delay_s = self._min_delay_s, math.inf
            self._window_end_s = now_s + WINDOW_S
        self._newest_time_s = time_s
        self._min_delay_s = min(self._min_delay_s, delay_s)
        return time_s + min(self._min_delay_s, self._previous_min_delay_s)


class SenderPool:
    """Sends the frames of one session to targets. All methods are safe to call from any thread.

    While no frames arrive, targets receive a face at rest. ``report`` is called with a target's
    address and problem when the problem changes. An empty problem means that it is solved.
    """

    def __init__(self, report: Callable[[str, str], None], *, idle_motion: bool) -> None:
        self._report = report
        self._senders: dict[TargetKey, _Sender] = {}
        self._rest = RestingFace(idle_motion=idle_motion)
        self._playout = PlayoutClock()
        self._newest_faps = np.zeros(NUM_FAPS, np.float32)
        self._newest_arrival_s = time.monotonic() - STALL_S - FADE_S
        self._newest_time_s = -STALL_S - FADE_S  # its media time
        self._timer: asyncio.TimerHandle | None = None  # next tick, while there are senders
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def start(self, target: Target) -> None:
        """Start sending to a target. The new options replace those of a running sender.

        Raises ``UserError`` if there are too many targets.
        """
        self._call(lambda: self._start(target))

    def stop(self, target: Target) -> None:
        """Stop sending to a target, whatever its options are."""
        self._call(lambda: self._stop(target.key))

    def set_delay(self, delay_s: float) -> None:
        """Set the delay of all targets; replaces the delays in their addresses."""
        self._call(lambda: self._set_delay(delay_s))

    @property
    def is_sending(self) -> bool:
        """Whether there are targets."""
        return bool(self._senders)

    def show(self, session_time_s: float, faps: Faps) -> None:
        """Queue a frame (68,) of the session; return immediately."""
        if self.is_sending:
            self._loop.call_soon_threadsafe(self._add_frame, session_time_s, faps, time.monotonic())

    def express(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions on the face at rest."""
        self._call(lambda: self._rest.express(strengths, hold_s))

    def states(self) -> list[SenderState]:
        """Return the state of each sender, in order of start."""
        return self._call(self._states)

    def close(self) -> None:
        """Stop all senders and the thread."""
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
        for key in list(self._senders):
            self._stop(key)
        await asyncio.gather(*tasks, return_exceptions=True)

    def _call(self, work: Callable[[], Result]) -> Result:
        async def run() -> Result:
            return work()

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result()

    def _start(self, target: Target) -> None:
        running = self._senders.get(target.key)
        if running is not None:
            if running.connection.target == target:
                return
            self._stop(target.key)
        if len(self._senders) >= MAX_SENDERS:
            raise UserError(f"already sending to {MAX_SENDERS} programs; stop one first")
        connection = make_connection(target)
        task = self._loop.create_task(connection.run())
        task.add_done_callback(lambda ended: _show_error(connection, ended))
        self._senders[target.key] = _Sender(connection, task)
        if self._timer is None:
            self._tick()

    def _stop(self, key: TargetKey) -> None:
        sender = self._senders.pop(key, None)
        if sender is not None:
            sender.task.cancel()
            if sender.timer is not None:
                sender.timer.cancel()

    def _set_delay(self, delay_s: float) -> None:
        for sender in self._senders.values():
            sender.connection.target = change_delay(sender.connection.target, delay_s)
            if sender.timer is not None:
                sender.timer.cancel()
            self._send_due(sender)

    def _states(self) -> list[SenderState]:
        since_s = self._loop.time() - RATE_WINDOW_S
        states = []
        for sender in self._senders.values():
            while sender.sent_s and sender.sent_s[0] < since_s:
                sender.sent_s.popleft()
            states.append(
                SenderState(
                    target=sender.connection.target.url,
                    delay_ms=round(1e3 * sender.connection.target.delay_s, 3),
                    contents=sender.connection.target.contents,
                    rate_hz=len(sender.sent_s) / RATE_WINDOW_S,
                    problem=sender.connection.problem,
                )
            )
        return states

    def _add_frame(self, session_time_s: float, faps: Faps, arrival_s: float) -> None:
        self._newest_faps = faps
        self._newest_arrival_s, self._newest_time_s = arrival_s, session_time_s
        earliest_s = self._playout.earliest_s(session_time_s, arrival_s)
        self._queue(FaceFrame(faps, session_time_s), earliest_s)

    def _tick(self) -> None:
        """Show the face at rest while no frames arrive, and report changed problems."""
        if not self._senders:
            self._timer = None
            return
        self._timer = self._loop.call_later(1.0 / RESTING_RATE_HZ, self._tick)
        now_s = time.monotonic()
        stalled_s = now_s - self._newest_arrival_s - STALL_S
        if stalled_s > 0:
            weight = max(0.0, 1.0 - stalled_s / FADE_S)
            time_s = self._newest_time_s + now_s - self._newest_arrival_s
            self._queue(
                FaceFrame(self._rest.blend(self._newest_faps, weight, now_s), time_s), now_s
            )
        for sender in self._senders.values():
            problem = sender.connection.problem
            if problem != sender.reported_problem:
                sender.reported_problem = problem
                self._report(sender.connection.target.url, problem)

    def _queue(self, frame: FaceFrame, earliest_s: float) -> None:
        for sender in self._senders.values():
            sender.queue.append((earliest_s, frame))
            if sender.timer is None:
                self._send_due(sender)

    def _send_due(self, sender: _Sender) -> None:
        sender.timer = None
        while sender.queue:
            earliest_s, frame = sender.queue[0]
            due_s = earliest_s + sender.connection.target.delay_s
            if due_s > time.monotonic():
                sender.timer = self._loop.call_at(due_s, self._send_due, sender)
                return
            sender.queue.popleft()
            try:
                is_sent = sender.connection.send(frame)
            except Exception as error:  # code of another distribution may raise any exception
                is_sent, sender.connection.problem = False, f"cannot send a frame: {error!r}"
            if is_sent:
                sender.sent_s.append(time.monotonic())


def _show_error(connection: TargetConnection, task: asyncio.Task[None]) -> None:
    """Show the error that ended a connection. Its protocol may come from another package."""
    error = None if task.cancelled() else task.exception()
    if error is not None:
        connection.problem = f"the connection ended: {error!r}; stop and restart sending"
