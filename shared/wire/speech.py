"""What the recognizer emits: voice activity, phones, lips, progress; and what the face answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.shared.wire.message import (
    Count,
    FapValues,
    FapValuesOrNone,
    LipDelay,
    LipValues,
    Message,
    PhoneSymbol,
    Probability,
    Samples,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Speech(Message):
    """Voice activity began (active) or ended at media_time."""

    active: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Phone(Message):
    """A recognised phone; media_time is its onset. The same index again revises it."""

    index: Count
    symbol: PhoneSymbol  # one of the session's language
    duration: Samples
    confidence: Probability
    final: bool  # false: the duration is an estimate


@dataclass(frozen=True, slots=True, kw_only=True)
class Lips(Message):
    """The mouth at media_time, from a lip model that works on the sound itself."""

    values: LipValues  # float32, little-endian, FAP units, in the order of MOUTH_FAPS
    delay: LipDelay  # how much sound after media_time the model has used; below 0: it foretells
    closure: Probability  # that the lips touch
    lip_to_teeth: Probability  # that the lower lip touches the teeth


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Message):
    """The sound is processed up to media_time."""

    level_db: Annotated[float, Meta(ge=-200, le=20)]  # RMS of the newest 20 ms, full scale = 0
    # sign changes a sample in the newest 20 ms
    zero_crossing_rate: Annotated[float, Meta(ge=0, le=1)] = 0.0
    pitch_hz: Annotated[float, Meta(ge=0, le=1000)] = 0.0  # of the voice there; 0: it has none


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfPhones(Message):
    """The session's sound ended at media_time; nothing more is emitted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stalled(Message):
    """The client sends no audio: the sound stands still at media_time until the next message."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResumeFace(Message):
    """A new synthesizer goes on behind the newest frame of the one before, of media_time."""

    frame: Count  # number of that frame
    faps: FapValues  # its 68 float32, little-endian, in FAP units


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledge(Message):
    """The receiver has every message of the session up to ``sequence``.

    It also tells the newest frame, of media_time, for a ``ResumeFace``.
    """

    frame: Count = 0  # number of the newest frame; 0: there is none
    faps: FapValuesOrNone = b""  # its 68 float32, little-endian, in FAP units
