"""Audio of sessions that are not paced. It waits while there is live audio to decode."""

from collections import deque
from collections.abc import Iterator

from kouxing.services.recognizer.resumption import Chunk
from kouxing.services.recognizer.session import RecognizerSession
from kouxing.shared.clock import MEDIA_RATE_HZ

_MIN_CHUNK_S = 0.001  # a shorter chunk counts as much


class UnpacedAudio:
    """A queue of chunks, in the order in which they arrived."""

    def __init__(self) -> None:
        self._items: deque[tuple[RecognizerSession, Chunk | None]] = deque()
        self.duration_s = 0.0  # duration of the queued audio

    def __len__(self) -> int:
        return len(self._items)

    def append(self, session: RecognizerSession, chunk: Chunk | None) -> None:
        """Add a chunk, or None at the end of a session's audio."""
        self._items.append((session, chunk))
        self.duration_s += _duration_s(session, chunk)

    def drop(self, session: RecognizerSession, *, keep_end: bool) -> None:
        """Remove a session's audio."""
        self._items = deque(
            item for item in self._items if item[0] is not session or (keep_end and item[1] is None)
        )
        self._measure()

    def take(self, max_s: float) -> Iterator[tuple[RecognizerSession, Chunk | None]]:
        """Yield chunks and ends from the front, up to a total duration."""
        while self._items and max_s > 0.0:
            session, chunk = self._items.popleft()
            if chunk is not None:
                media_time, samples = chunk
                rate_hz = session.start.sample_rate_hz
                num_samples = max(1, round(max_s * rate_hz))
                if num_samples < len(samples):
                    rest_time = media_time + num_samples * MEDIA_RATE_HZ // rate_hz
                    self._items.appendleft((session, (rest_time, samples[num_samples:])))
                    samples = samples[:num_samples]
                max_s -= len(samples) / rate_hz
                chunk = media_time, samples
            yield session, chunk
        self._measure()

    def _measure(self) -> None:
        self.duration_s = sum(_duration_s(*item) for item in self._items)


def _duration_s(session: RecognizerSession, chunk: Chunk | None) -> float:
    if chunk is None:
        return 0.0
    return max(_MIN_CHUNK_S, len(chunk[1]) / session.start.sample_rate_hz)
