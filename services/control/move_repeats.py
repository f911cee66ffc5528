"""Repeats move messages to clients, because their connection may have broken."""

import heapq
import math
from collections.abc import Iterator

from kouxing.shared.wire.session import SessionMoved

REPEAT_AFTER_S = (1.0, 2.0, 4.0, 8.0)


class MoveRepeats:
    """The messages to repeat, in order of time."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, str, SessionMoved]] = []

    def add(self, moved: SessionMoved, now_s: float) -> None:
        """Repeat a message several times from now on."""
        for delay_s in REPEAT_AFTER_S:
            heapq.heappush(self._heap, (now_s + delay_s, moved.session, moved))

    @property
    def due_s(self) -> float:
        """Time at which the next message must be repeated."""
        return self._heap[0][0] if self._heap else math.inf

    def due(self, now_s: float) -> Iterator[SessionMoved]:
        """Remove and yield the messages to repeat now."""
        while self._heap and self._heap[0][0] <= now_s:
            yield heapq.heappop(self._heap)[2]
