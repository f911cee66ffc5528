"""Queue of one session's audio that is not decoded yet."""

from collections import deque
from collections.abc import Iterator

from kouxing.services.recognizer.sessions.resumption import Chunk
from kouxing.shared.clock import MEDIA_RATE_HZ, to_seconds
from kouxing.shared.service.overload import SkipPolicy

_MIN_CHUNK_S = 0.001  # shorter chunks count as this duration, because decoding them takes as long


class AudioQueue:
    """A queue of chunks that drops old audio. Times are in seconds, on any monotonic clock."""

    def __init__(self, sample_rate_hz: int, skip_policy: SkipPolicy) -> None:
        self.skip_policy = skip_policy
        self._rate_hz = sample_rate_hz
        self._chunks: deque[Chunk] = deque()
        self._num_samples = 0  # in the queue
        self._end = 0  # media time of the end of the newest chunk

    def __bool__(self) -> bool:
        return bool(self._chunks)

    @property
    def duration_s(self) -> float:
        """Duration of the queued audio. Each chunk, even an empty one, counts as at least 1 ms."""
        return max(self._num_samples / self._rate_hz, _MIN_CHUNK_S * len(self._chunks))

    @property
    def media_time(self) -> int:
        """Media time of the oldest queued sample; there must be a chunk."""
        return self._chunks[0][0]

    def append(self, chunk: Chunk, now_s: float) -> None:
        """Add a chunk that has arrived."""
        media_time, samples = chunk
        end = media_time + len(samples) * MEDIA_RATE_HZ // self._rate_hz
        duration_s = to_seconds(max(0, end - self._end))
        self.skip_policy.add(duration_s, now_s, has_queued=bool(self._chunks))
        self._end = end
        self._chunks.append(chunk)
        self._num_samples += len(samples)

    def clear(self) -> None:
        """Drop all chunks."""
        self._chunks.clear()
        self._num_samples = 0

    def is_outdated(self, now_s: float) -> bool:
        """Return whether even the newest chunk is late, so that more audio should have arrived."""
        return bool(self._chunks) and self.skip_policy.is_late(now_s)

    def skip_old(self, now_s: float) -> bool:
        """Skip audio that is too old; return whether any was skipped."""
        has_skipped = self.skip_policy.update(self._waiting_s, now_s)
        if has_skipped:
            self._num_samples = len(self._chunks[-1][1])
            while len(self._chunks) > 1:
                self._chunks.popleft()
        return has_skipped

    def take(self, max_s: float) -> Iterator[Chunk]:
        """Yield chunks from the front, up to a total duration."""
        num_left = max(1, round(max_s * self._rate_hz))
        while self._chunks and num_left > 0:
            media_time, samples = self._chunks.popleft()
            taken, rest = samples[:num_left], samples[num_left:]
            if len(rest):
                rest_time = media_time + num_left * MEDIA_RATE_HZ // self._rate_hz
                self._chunks.appendleft((rest_time, rest))
            num_left -= max(len(taken), round(_MIN_CHUNK_S * self._rate_hz))
            self._num_samples -= len(taken)
            yield media_time, taken

    @property
    def _waiting_s(self) -> float:
        """Duration of the audio that arrived before the newest chunk."""
        return (self._num_samples - len(self._chunks[-1][1])) / self._rate_hz
