"""What one viewer has yet to be sent: bounded, and rather new than complete."""

from __future__ import annotations

import asyncio
from collections import deque
from enum import Enum

MAX_WAITING = 200  # messages; 2 s of a talking session
NUM_FRAMES_KEPT = 5
NUM_TEXTS_KEPT = 50


class Kind(Enum):
    """What a message is, and so whether an old one is worth anything."""

    TEXT = "text"
    FRAME = "frame"
    SHAPES = "shapes"  # of a frame
    REST = "rest"  # the face while no session moves it
    REST_SHAPES = "rest shapes"
    SOUND = "sound"


class Outbox:
    """A queue that a slow viewer cannot make grow: it drops to the newest FAP frames."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Kind, str | bytes]] = deque()
        self._filled = asyncio.Event()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, kind: Kind, message: str | bytes) -> int:
        """Queue a message; return how many were dropped to make room."""
        self._waiting.append((kind, message))
        self._filled.set()
        return self._shed() if len(self._waiting) > MAX_WAITING else 0

    async def get(self) -> str | bytes:
        """Return the oldest message, waiting for one."""
        while not self._waiting:
            self._filled.clear()
            await self._filled.wait()
        return self._waiting.popleft()[1]

    def _shed(self) -> int:
        # Sound that is seconds late is of no use, and with it the frames that belong to it. Text
        # (which session this is, errors) keeps its order among the frames that remain.
        num_before = len(self._waiting)
        room = {
            Kind.SOUND: 0,
            Kind.FRAME: NUM_FRAMES_KEPT,
            Kind.SHAPES: NUM_FRAMES_KEPT,
            Kind.REST: 1,
            Kind.REST_SHAPES: 1,
            Kind.TEXT: NUM_TEXTS_KEPT,
        }
        kept: deque[tuple[Kind, str | bytes]] = deque()
        for kind, message in reversed(self._waiting):
            if room[kind] > 0:
                room[kind] -= 1
                kept.appendleft((kind, message))
        self._waiting = kept
        return num_before - len(kept)
