"""The audio of one session until the recognizer acknowledges it; no I/O, the caller passes time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from kouxing_client.messages import MEDIA_RATE_HZ, Fields

RESEND_S = 10.0  # acknowledged audio that is kept in case another recognizer needs it
MAX_KEPT = 5000  # messages
ANSWER_S = (0.6, 10.0)  # shortest and longest wait for an acknowledgement before reconnecting
UNPACED_ANSWER_S = 5.0  # shortest wait if audio arrives faster than real time and may queue
NEAREST_MS = 50  # shortest limit for making a connection
QUICK_ANSWER_S = 2.5  # up to this wait, the round trip measured before limits a new connection
MAX_TIMED = 200  # messages whose send time is remembered


class AudioStream:
    """Numbers audio messages, keeps them while they may be needed, and detects a dead connection.

    Parameters
    ----------
    sample_rate_hz
        Sample rate of the audio.
    is_paced
        Whether audio arrives in real time.

    Attributes
    ----------
    sequence
        Number of the newest message; 0 if there is no message.
    acknowledged
        Number of the newest message that the recognizer has.
    round_trip_ms
        Twice the shortest time to an acknowledgement; None before the first one.
    """

    def __init__(self, sample_rate_hz: int, *, is_paced: bool) -> None:
        self.sequence = self.acknowledged = 0
        self.round_trip_ms: int | None = None
        self._sample_rate_hz = sample_rate_hz
        self._num_frames = 0  # of all chunks
        self._kept: deque[Fields] = deque(maxlen=MAX_KEPT)
        self._next = 1  # number of the next message for the socket
        self._sent_s: deque[tuple[int, float]] = deque(maxlen=MAX_TIMED)  # sequence and time
        self._progress_s = 0.0  # time of the last acknowledgement, or of the first open message
        self._min_answer_s = ANSWER_S[0] if is_paced else UNPACED_ANSWER_S
        self._answer_s = self._min_answer_s  # how long to wait before reconnecting

    @property
    def media_time(self) -> int:
        """Media time of the next chunk, samples at 16 kHz."""
        return self._num_frames * MEDIA_RATE_HZ // self._sample_rate_hz

    @property
    def num_unacknowledged(self) -> int:
        """Number of messages that the recognizer must still acknowledge; any thread may ask."""
        return min(self.sequence - self.acknowledged, len(self._kept))

    def connect_ms(self, default: int) -> int:
        """Return the time limit for a new connection.

        A packet that is lost while a connection is made costs the whole limit.
        """
        if self.round_trip_ms is None or self._answer_s > QUICK_ANSWER_S:
            return default
        return min(self.round_trip_ms, default)

    def add(self, fields: Fields, num_frames: int, now_s: float) -> None:
        """Add a chunk of ``num_frames`` samples per channel."""
        if self.acknowledged == self.sequence:
            self._progress_s = now_s
        self.sequence += 1
        numbered = {**fields, "sequence": self.sequence, "media_time": self.media_time}
        self._kept.append({**numbered, "acknowledge": True})
        self._sent_s.append((self.sequence, now_s))
        oldest = self.media_time - RESEND_S * MEDIA_RATE_HZ
        self._num_frames += num_frames
        while self._kept[0]["sequence"] <= self.acknowledged:
            if self._kept[0]["media_time"] >= oldest:
                break
            self._kept.popleft()

    def skip(self, num_frames: int) -> None:
        """Advance media time without audio."""
        self._num_frames += num_frames

    def unsent(self) -> Iterator[Fields]:
        """Yield messages for the socket; requesting the next one marks the last one as sent."""
        while self._kept and self._next <= self.sequence:
            first = self._kept[0]["sequence"]
            self._next = max(self._next, first)
            yield self._kept[self._next - first]
            self._next += 1

    def acknowledge(self, sequence: int, now_s: float) -> None:
        """Mark all messages up to ``sequence`` as received."""
        if sequence <= self.acknowledged:
            return
        while self._sent_s and self._sent_s[0][0] <= sequence:
            number, sent_s = self._sent_s.popleft()
            if number == sequence:
                measured_ms = max(round(2e3 * (now_s - sent_s)), NEAREST_MS)
                self.round_trip_ms = min(measured_ms, self.round_trip_ms or measured_ms)
        self.acknowledged = min(sequence, self.sequence)
        self._progress_s = now_s
        self._answer_s = max(self._min_answer_s, self._answer_s / 2)

    def is_stuck(self, now_s: float) -> bool:
        """Return whether acknowledgements have stopped, so the connection may be dead."""
        # A recognizer that never acknowledges is an older one.
        is_behind = self.acknowledged > 0 and self.num_unacknowledged > 0
        return is_behind and now_s - self._progress_s > self._answer_s

    def resend(self, now_s: float) -> None:
        """Send unacknowledged messages again, and wait longer for the next acknowledgement."""
        self._answer_s = min(2 * self._answer_s, ANSWER_S[1])
        self._next = self.acknowledged + 1
        self._progress_s = now_s

    def move(self, next_sequence: int, now_s: float) -> None:
        """Continue at another recognizer, which needs messages from ``next_sequence`` on."""
        self.acknowledged = next_sequence - 1
        self._next = next_sequence
        self._progress_s = now_s

    def flush(self) -> None:
        """Forget all audio: none of it is sent, or sent again."""
        self._kept = deque(
            (message for message in self._kept if "last" in message), maxlen=MAX_KEPT
        )
