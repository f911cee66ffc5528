"""A client's audio messages, once and in order, though some come again and some late.

ZeroMQ loses what is under way when a connection ends. A client that asks for acknowledgements sends
that again; what has come meanwhile is held until then, for a while.
"""

from __future__ import annotations

from kouxing.shared.wire.audio import AudioChunk

WAIT_S = 1.0  # for messages that are missing
MAX_HELD = 2**20  # bytes held meanwhile
_MESSAGE_BYTES = 500  # that a message takes without its PCM


class AudioOrder:
    """Puts the messages of one client in order; the first one that comes begins.

    Attributes
    ----------
    last : int
        Number of the newest message that was passed on, 0 before the first.
    """

    def __init__(self) -> None:
        self.last = 0
        self._held: dict[int, AudioChunk] = {}  # those behind the hole
        self._num_bytes = 0  # of them
        self._hole_since_s = 0.0

    def accept(self, message: AudioChunk, now_s: float) -> list[AudioChunk]:
        """Take a message that is newer than the last; return those that are in order now."""
        if not self._held:
            self._hole_since_s = now_s
        if message.sequence not in self._held:
            self._held[message.sequence] = message
            self._num_bytes += _num_bytes(message)
        if self.last == 0 or not message.acknowledge or self._num_bytes > MAX_HELD:
            self.last = min(self._held) - 1
        return self._next(now_s)

    def tick(self, now_s: float) -> list[AudioChunk]:
        """Return what goes on behind a hole that nobody has filled for too long."""
        if not self._held or now_s - self._hole_since_s < WAIT_S:
            return []
        self.last = min(self._held) - 1
        return self._next(now_s)

    def _next(self, now_s: float) -> list[AudioChunk]:
        """Return the messages up to the next hole, which begins to wait."""
        ready = []
        while self.last + 1 in self._held:
            self.last += 1
            message = self._held.pop(self.last)
            self._num_bytes -= _num_bytes(message)
            ready.append(message)
        if ready:
            self._hole_since_s = now_s
        return ready


def _num_bytes(message: AudioChunk) -> int:
    return _MESSAGE_BYTES + len(message.pcm)
