"""The recognizer's results, and the synthesizer's acknowledgement."""

from enum import StrEnum
from typing import Annotated, ClassVar

from kouxing_client.field_types import Count, FapValues, Name, Probability, Samples
from kouxing_client.messages import Phone, Speech
from msgspec import Meta, Struct, field

from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.wire.message import RegisteredMessage

MAX_BATCHED_MESSAGES = 8  # so that a batch fits into the limit of the synthesizer's socket
_BATCHED = Meta(max_length=MAX_BATCHED_MESSAGES)
LipValues = Annotated[bytes, Meta(min_length=4 * len(MOUTH_FAPS), max_length=4 * len(MOUTH_FAPS))]
Feeling = Annotated[float, Meta(ge=-1, le=1)]
LipDelay = Annotated[int, Meta(ge=-16_000, le=16_000)]  # samples at 16 kHz


class AudioState(StrEnum):
    """The states of the audio in ``progress``."""

    RUNNING = "running"
    STALLED = "stalled"  # the client sends no audio, so media time does not advance
    RESUMED = "resumed"  # the client sends audio again, which is not processed yet
    SKIPPED = "skipped"  # the audio before this time was too old, and was skipped
    ENDED = "ended"  # no more results follow


class AcousticModelName(StrEnum):
    """The acoustic models of a session."""

    FULL = "full"  # the recognizer's
    LIGHT = "light"  # more errors, less processor time


class Acoustic(RegisteredMessage, frozen=True, kw_only=True):
    """The acoustic model that finds the phones from now on.

    Repeated when speech starts, and after a move to another recognizer.
    """

    published_at: ClassVar[str] = "phones"

    model: Name = AcousticModelName.FULL


class LipPositions(RegisteredMessage, frozen=True, kw_only=True):
    """The mouth at media_time, from a lip model that works on the audio itself."""

    published_at: ClassVar[str] = "phones"

    values: LipValues  # float32, little-endian, FAP units, in the order of MOUTH_FAPS
    delay_samples: LipDelay  # audio after media_time that the model used; below 0: it predicts
    closure: Probability  # probability that the lips touch
    lip_to_teeth: Probability  # probability that the lower lip touches the teeth


class NewestFrame(Struct, frozen=True, kw_only=True):
    """The newest FAP frame that a synthesizer has published."""

    sequence: Count
    media_time: Samples
    values: FapValues  # 68 float32, little-endian, in FAP units


class Progress(RegisteredMessage, frozen=True, kw_only=True):
    """The audio is processed up to media_time."""

    state: Name = AudioState.RUNNING
    level_db: Annotated[float, Meta(ge=-200, le=20)] = -200.0  # RMS of the newest 20 ms, dBFS
    zero_crossing_rate: Probability = 0.0  # sign changes per sample in the newest 20 ms
    pitch_hz: Annotated[float, Meta(gt=0, le=1000)] | None = None  # None: unvoiced
    arousal: Feeling = 0.0  # arousal in the voice, relative to the speaker's mean
    valence: Feeling = 0.0  # valence, relative to the speaker's mean; below 0: unpleasant
    laughter: bool = False  # laughter, which is not speech
    breath: bool = False  # audible breath
    # Newest frame of the lost synthesizer; the new one continues after it. In the first message of
    # an epoch
    newest_frame: NewestFrame | None = None


class Results(RegisteredMessage, frozen=True, kw_only=True):
    """Messages that the recognizer sends together; ``sequence`` is their order."""

    phones: Annotated[list[Phone], _BATCHED] = field(default_factory=list)
    lip_positions: Annotated[list[LipPositions], _BATCHED] = field(default_factory=list)
    speech: Annotated[list[Speech], _BATCHED] = field(default_factory=list)
    progress: Annotated[list[Progress], _BATCHED] = field(default_factory=list)


class Acknowledge(RegisteredMessage, frozen=True, kw_only=True):
    """Every message of the session up to ``sequence`` has arrived.

    Sent by the recognizer to the client, and by the synthesizer to the recognizer.
    """

    newest_frame: NewestFrame | None = None  # a synthesizer's newest frame; None: no frame yet
