"""What every message carries, and the types of its fields.

A message is two ZeroMQ parts: the topic ``<kind>/<session>/`` and a msgpack map of the fields of
its class; ``proto/PROTOCOL.md`` is the authority. The kind is the class name in kebab-case:
``FapFrame`` is a ``fap-frame``. Adding an optional field with a default keeps the version; anything
else is a new version.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, ClassVar

from msgspec import Meta

from kouxing.shared.face.expressions import (
    MAX_EXPRESSIVENESS,
    MAX_HOLD_S,
    MIN_EXPRESSIVENESS,
    ExpressionName,
)
from kouxing.shared.face.faps import MASK_BYTES, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.lip_models import MAX_MOUTH_PROFILE_BYTES, LipModelName
from kouxing.shared.face.shape_names import MAX_SHAPES, ShapeSetName

VERSION = 2
DOCUMENT = "proto/PROTOCOL.md"
MAX_AUDIO_BYTES = 64 * 1024
MAX_COMMAND_BYTES = 256 * 1024  # to control: a heartbeat with 2000 sessions
MAX_MESSAGE_BYTES = 1024 * 1024

Version = Annotated[int, Meta(ge=1, le=65535)]
SessionName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{0,64}$")]
Name = Annotated[str, Meta(min_length=1, max_length=128)]
NameOrNone = Annotated[str, Meta(max_length=128)]  # empty: none
Address = Annotated[bytes, Meta(max_length=255)]  # of a ROUTER's peer
Text = Annotated[str, Meta(max_length=2000)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Samples = Annotated[int, Meta(ge=0, le=2**53)]
LipDelay = Annotated[int, Meta(ge=-16_000, le=16_000)]  # samples at 16 kHz
Nanoseconds = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Encoding = Annotated[str, Meta(pattern="^(s16le|f32le)$")]
SampleRate = Annotated[int, Meta(ge=8000, le=48000)]  # Hz
NumChannels = Annotated[int, Meta(ge=1, le=2)]
FrameRate = Annotated[float, Meta(ge=0, le=1000)]  # Hz; 0: not known
Delay = Annotated[float, Meta(ge=0, le=1000)]  # ms
LanguageName = Annotated[str, Meta(max_length=64)]  # empty: not known
PhoneSymbol = Annotated[str, Meta(pattern=r"^[a-z]{1,4}$")]
LipsOrNone = Annotated[str, Meta(max_length=64)]  # empty: not chosen
ChosenLips = Annotated[str, Meta(pattern=f"^({'|'.join(LipModelName)})$")]
KnownExpression = Annotated[str, Meta(pattern=f"^({'|'.join(ExpressionName)})$")]
Strength = Annotated[float, Meta(ge=0, le=1)]
ExpressionMap = Annotated[dict[KnownExpression, Strength], Meta(max_length=len(ExpressionName))]
HoldTime = Annotated[float, Meta(ge=0, le=MAX_HOLD_S)]  # s
ExpressivenessAmount = Annotated[float, Meta(ge=MIN_EXPRESSIVENESS, le=MAX_EXPRESSIVENESS)]
ExpressivenessOrNone = Annotated[float, Meta(ge=0, le=MAX_EXPRESSIVENESS)]  # 0: not chosen
MouthProfile = Annotated[
    bytes, Meta(max_length=MAX_MOUTH_PROFILE_BYTES)
]  # empty: the average speaker
Endpoint = Annotated[str, Meta(max_length=256)]
FapValues = Annotated[bytes, Meta(min_length=4 * NUM_FAPS, max_length=4 * NUM_FAPS)]
FapValuesOrNone = Annotated[bytes, Meta(max_length=4 * NUM_FAPS)]  # empty: not told
KnownShapes = Annotated[str, Meta(pattern=f"^({'|'.join(ShapeSetName)})$")]
ShapeSets = Annotated[list[KnownShapes], Meta(max_length=len(ShapeSetName))]
ShapeNames = Annotated[list[Name], Meta(max_length=MAX_SHAPES)]
ShapeNameMap = Annotated[dict[Name, ShapeNames], Meta(max_length=16)]
ShapeWeights = Annotated[bytes, Meta(max_length=4 * MAX_SHAPES)]
LipValues = Annotated[bytes, Meta(min_length=4 * len(MOUTH_FAPS), max_length=4 * len(MOUTH_FAPS))]
FapMask = Annotated[bytes, Meta(min_length=MASK_BYTES, max_length=MASK_BYTES)]
EndpointMap = Annotated[dict[Name, Endpoint], Meta(max_length=16)]
Probability = Annotated[float, Meta(ge=0, le=1)]
Share = Annotated[float, Meta(ge=0, le=1)]
MetricMap = Annotated[dict[Name, float], Meta(max_length=64)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What every message carries."""

    kind: ClassVar[str]  # the class name in kebab-case

    version: Version = VERSION
    session: SessionName = ""  # empty where no session is concerned
    epoch: Count = 0  # counts the placements of a session
    sequence: Count = 0  # grows by one per sender, socket and session
    media_time: Samples = 0  # samples at 16 kHz since the session's first sample

    def __init_subclass__(cls) -> None:
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()
