"""Bounded queue of one viewer's messages.

If the viewer is too slow, old messages are dropped, so that new frames are not late.
"""

import asyncio
from collections import deque
from enum import Enum

MAX_QUEUED = 100  # messages; about a second of a talking session
NUM_FRAMES_KEPT = 5  # when old messages are dropped
NUM_TEXTS_KEPT = 50


class MessageKind(Enum):
    """Kind of a queued message, and how many old messages of this kind are kept."""

    STATUS = "status", 1  # this kind and the next six describe a state: the newest always arrives
    SHAPE_NAMES = "shape names", 1  # what the weights of the following shapes mean
    SESSION = "session", 1
    FACE = "face", 1
    ACOUSTIC = "acoustic", 1
    SPEECH = "speech", 1
    END = "end", 1
    TEXT = "text", NUM_TEXTS_KEPT  # phones, syllables and errors
    FRAME = "frame", NUM_FRAMES_KEPT
    SHAPES = "shapes", NUM_FRAMES_KEPT  # blendshapes of a frame
    REST = "rest", 1  # the face while no session moves it
    REST_SHAPES = "rest shapes", 1
    SOUND = "sound", 0

    def __init__(self, _name: str, num_kept: int) -> None:
        self.num_kept = num_kept


class ViewerQueue:
    """A queue that drops old messages when its reader is too slow."""

    def __init__(self) -> None:
        self._messages: deque[tuple[MessageKind, str | bytes]] = deque()
        self._not_empty = asyncio.Event()

    def __len__(self) -> int:
        return len(self._messages)

    def put(self, kind: MessageKind, message: str | bytes) -> int:
        """Queue a message; return the number of messages dropped to make room."""
        self._messages.append((kind, message))
        self._not_empty.set()
        return self._drop_old() if len(self._messages) > MAX_QUEUED else 0

    async def get(self) -> str | bytes:
        """Remove and return the oldest message; wait if the queue is empty."""
        while not self._messages:
            self._not_empty.clear()
            await self._not_empty.wait()
        return self._messages.popleft()[1]

    def _drop_old(self) -> int:
        # Sound that is seconds late is useless, and so are the frames of that sound. The remaining
        # messages keep their order.
        num_before = len(self._messages)
        num_left = {kind: kind.num_kept for kind in MessageKind}
        remaining: deque[tuple[MessageKind, str | bytes]] = deque()
        for kind, message in reversed(self._messages):
            if num_left[kind] > 0:
                num_left[kind] -= 1
                remaining.appendleft((kind, message))
            if kind is MessageKind.SHAPE_NAMES:  # older weights have other names
                num_left[MessageKind.SHAPES] = num_left[MessageKind.REST_SHAPES] = 0
        self._messages = remaining
        return num_before - len(remaining)
