"""The results of a recognizer: phones, lip positions, voice activity and level.

Times are media time: seconds from the session's first sample. ``shared/wire/events.py`` converts
these events to messages and back, without loss, because live results have whole samples at 16 kHz.

Two types are needed. Phones of a known text, and phones that a lip model moves, have times between
samples, and a lip model does not depend on the protocol. A message has whole samples, packed values
and checked ranges, and a session, an epoch and a sequence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from kouxing.shared.arrays import Floats
from kouxing.shared.clock import to_seconds
from kouxing.shared.fast_record import Record
from kouxing.shared.phones.inventory import SILENCE

if TYPE_CHECKING:
    from kouxing_client import messages


class Phone(Record, frozen=True, kw_only=True):
    """One recognized phone.

    A live recognizer emits the same ``index`` at least twice: first with an estimated duration
    (``final`` false), then with the measured onset and duration (``final`` true). An extra phone
    is withdrawn: its last emission is silence without duration.
    """

    index: int  # counts the phones of a session from 0
    symbol: str  # one of the inventory's phones
    onset_s: float  # seconds from the session's first sample
    duration_s: float  # seconds
    confidence: float  # 0 to 1
    final: bool

    @classmethod
    def from_message(cls, message: messages.Phone) -> Phone:
        """Return the phone in a message."""
        return cls(
            index=message.index,
            symbol=message.symbol,
            onset_s=to_seconds(message.media_time),
            duration_s=to_seconds(message.duration),
            confidence=message.confidence,
            final=message.final,
        )

    @property
    def end_s(self) -> float:
        """Seconds from the session's first sample."""
        return self.onset_s + self.duration_s

    @property
    def is_withdrawn(self) -> bool:
        """Whether the phone was emitted by mistake."""
        return self.final and self.duration_s == 0.0

    @property
    def is_spoken(self) -> bool:
        """Whether the phone is final and audible, as in ``kouxing_client.Phone.is_spoken``."""
        return self.final and self.duration_s > 0.0 and self.symbol != SILENCE


class LipPositions(Record, frozen=True, kw_only=True):
    """The mouth at one time, predicted from the audio."""

    time_s: float  # seconds from the session's first sample
    delay_s: float  # audio was known up to time_s + delay_s; negative: a forecast
    faps: Floats  # (28,) FAP units, in the order of MOUTH_FAPS; 0 where not tracked
    closure: float  # probability that the lips touch, 0 to 1
    lip_to_teeth: float  # probability that the lower lip touches the teeth, 0 to 1


class SpeechChange(Record, frozen=True, kw_only=True):
    """Start or end of voice activity."""

    active: bool
    time_s: float  # seconds from the session's first sample


class Progress(Record, frozen=True, kw_only=True):
    """Audio is processed up to ``time_s``. No later phone ends before this time."""

    time_s: float
    level_db: float  # RMS of the newest 20 ms, full scale = 0
    zero_crossing_rate: float = 0.0  # sign changes per sample in the newest 20 ms, 0 to 1
    pitch_hz: float = 0.0  # in the newest 20 ms; 0: unvoiced
    arousal: float = 0.0  # relative to the speaker's mean, -1 to 1
    valence: float = 0.0  # relative to the speaker's mean, -1 to 1; below 0 is unpleasant
    is_laughter: bool = False  # laughter is not speech
    is_breath: bool = False  # audible breath, for example before speech


class AudioSkipped(Record, frozen=True, kw_only=True):
    """The recognizer was too slow and skipped the audio before ``time_s``."""

    time_s: float


class EndOfSound(Record, frozen=True, kw_only=True):
    """The audio has ended."""

    time_s: float


class Waveform(Record, frozen=True, kw_only=True):
    """A chunk of the session's audio, as the recognizer processes it."""

    time_s: float  # time of the first sample
    samples: Floats  # (n,) 16 kHz mono


SoundEvent = Phone | LipPositions | SpeechChange | Progress | AudioSkipped | EndOfSound


def time_of(event: SoundEvent) -> float:
    """Return the media time of an event, seconds; of a phone, its onset."""
    return event.onset_s if isinstance(event, Phone) else event.time_s
