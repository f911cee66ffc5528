"""Audio messages of one session until the recognizer has them. Pure code: time is handed in."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

from kouxing_client.messages import Fields

END_OF_AUDIO = "end-of-audio"
MEDIA_RATE_HZ = 16000
RESEND_S = 10.0  # audio kept for a recognizer that takes the place of a lost one
ANSWER_S = (0.6, 10.0)  # without an acknowledgement, at first and at most, to connect again
HURRIED_ANSWER_S = 5.0  # at first, where audio comes as fast as it is taken and may wait for long


class AudioMessage(NamedTuple):
    """A chunk, or the end of the audio."""

    kind: str
    fields: Fields


class AudioLine:
    """Numbers the messages, keeps them as long as they may be needed, and says what goes next.

    Parameters
    ----------
    sample_rate_hz
        Of the audio.
    is_paced
        Whether it comes in real time.

    Attributes
    ----------
    sequence
        Number of the newest message, 0 without any.
    acknowledged
        Number of the newest message that the recognizer has.
    """

    def __init__(self, sample_rate_hz: int, *, is_paced: bool) -> None:
        self.sequence = self.acknowledged = 0
        self._sample_rate_hz = sample_rate_hz
        self._num_frames = 0  # of all chunks
        self._kept: deque[AudioMessage] = deque()
        self._next = 1  # number of the next message for the socket
        self._progress_s = 0.0  # when something was acknowledged, or the first message waited
        self._least_answer_s = ANSWER_S[0] if is_paced else HURRIED_ANSWER_S
        self._answer_s = self._least_answer_s  # how long to wait for more

    @property
    def media_time(self) -> int:
        """Media time of the next chunk, samples at 16 kHz."""
        return self._num_frames * MEDIA_RATE_HZ // self._sample_rate_hz

    def add(self, kind: str, fields: Fields, num_frames: int, now_s: float) -> None:
        """Add a chunk of so many samples (of each channel), or the end of the audio."""
        if self.acknowledged == self.sequence:
            self._progress_s = now_s
        self.sequence += 1
        numbered = {**fields, "sequence": self.sequence, "media_time": self.media_time}
        self._kept.append(AudioMessage(kind, {**numbered, "acknowledge": True}))
        self._num_frames += num_frames
        oldest = self.media_time - RESEND_S * MEDIA_RATE_HZ
        while self._kept[0].fields["sequence"] <= self.acknowledged:
            if self._kept[0].fields["media_time"] >= oldest:
                break
            self._kept.popleft()

    def waiting(self) -> Iterator[AudioMessage]:
        """Yield what goes to the socket; whoever asks for one more says that the last one went."""
        while self._kept and self._next <= self.sequence:
            first = self._kept[0].fields["sequence"]
            self._next = max(self._next, first)
            yield self._kept[self._next - first]
            self._next += 1

    def acknowledge(self, sequence: int, now_s: float) -> None:
        """Take the recognizer's word that it has all messages up to a number."""
        if sequence > self.acknowledged:
            self.acknowledged = min(sequence, self.sequence)
            self._progress_s = now_s
            self._answer_s = max(self._least_answer_s, self._answer_s / 2)

    def is_stuck(self, now_s: float) -> bool:
        """Return whether the connection may be dead: nothing is acknowledged any more."""
        is_behind = 0 < self.acknowledged < self.sequence  # an older recognizer says nothing
        return is_behind and now_s - self._progress_s > self._answer_s

    def resend(self, now_s: float) -> None:
        """Send over a new connection what is not acknowledged; be more patient with it."""
        self._answer_s = min(2 * self._answer_s, ANSWER_S[1])
        self._next = self.acknowledged + 1
        self._progress_s = now_s

    def move(self, next_sequence: int, now_s: float) -> None:
        """Send to another recognizer what it does not have."""
        self.acknowledged = next_sequence - 1
        self._next = next_sequence
        self._progress_s = now_s

    def flush(self) -> None:
        """Forget all audio: none of it is sent, or sent again. Its time has passed."""
        self._kept = deque(each for each in self._kept if each.kind == END_OF_AUDIO)
