"""Puts a client's audio messages in order, each message once.

ZeroMQ loses messages in flight when a connection ends. A client that asks for acknowledgements
resends them. Until then, later messages are held for a limited time.
"""

from kouxing.shared.wire.audio import AudioChunk

WAIT_S = 1.0  # for missing messages
MAX_HELD_BYTES = 2**20
_MESSAGE_BYTES = 500  # memory of a message without its PCM


class AudioOrder:
    """Orders the messages of one client, starting with the first that arrives."""

    def __init__(self) -> None:
        self.last = 0  # number of the newest message that was returned
        self._held: dict[int, AudioChunk] = {}  # messages behind a gap
        self._held_bytes = 0
        self._gap_since_s = 0.0

    def push(self, message: AudioChunk, now_s: float) -> list[AudioChunk]:
        """Add a message newer than the last; return the messages that are now in order."""
        if not self._held:
            self._gap_since_s = now_s
        if message.sequence not in self._held:
            self._held[message.sequence] = message
            self._held_bytes += _num_bytes(message)
        if self.last == 0 or not message.acknowledge or self._held_bytes > MAX_HELD_BYTES:
            self.last = min(self._held) - 1
        return self._next(now_s)

    def tick(self, now_s: float) -> list[AudioChunk]:
        """Return the messages behind a gap that was not filled in time."""
        if not self._held or now_s - self._gap_since_s < WAIT_S:
            return []
        self.last = min(self._held) - 1
        return self._next(now_s)

    def _next(self, now_s: float) -> list[AudioChunk]:
        """Return the messages up to the next gap."""
        ready = []
        while self.last + 1 in self._held:
            self.last += 1
            message = self._held.pop(self.last)
            self._held_bytes -= _num_bytes(message)
            ready.append(message)
        if ready:
            self._gap_since_s = now_s
        return ready


def _num_bytes(message: AudioChunk) -> int:
    return _MESSAGE_BYTES + len(message.pcm)
