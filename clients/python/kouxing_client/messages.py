"""The messages that a client reads and writes; PROTOCOL.md describes them."""

from __future__ import annotations

import sys
from array import array
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import msgspec

if TYPE_CHECKING:
    Floats = array[float]
else:
    Floats = array  # a type that msgspec can evaluate

VERSION = 3
MEDIA_RATE_HZ = 16000
NUM_FAPS = 68
SILENCE = "sil"  # the phone of a pause, in every language
Fields = dict[str, Any]
SHAPE_NAMES: dict[str, tuple[str, ...]] = {
    "arkit": tuple(
        """
        browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff
        cheekSquintLeft cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft
        eyeLookDownRight eyeLookInLeft eyeLookInRight eyeLookOutLeft eyeLookOutRight eyeLookUpLeft
        eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight jawForward jawLeft
        jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft
        mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight
        mouthPressLeft mouthPressRight mouthPucker mouthRight mouthRollLower mouthRollUpper
        mouthShrugLower mouthShrugUpper mouthSmileLeft mouthSmileRight mouthStretchLeft
        mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft noseSneerRight
        tongueOut
        """.split()
    ),
    "oculus": tuple("sil PP FF TH DD kk CH SS nn RR aa E ih oh ou".split()),
    "vrm": tuple(
        "aa ih ou ee oh blink blinkLeft blinkRight lookUp lookDown lookLeft lookRight".split()
    ),
}


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Fields that every message has."""

    kind: ClassVar[str]  # first part of the topic

    version: int = VERSION
    session: str = ""
    epoch: int = 0
    """placement of the session; it grows each time the session moves to another process"""
    sequence: int = 0
    """sequence number of the message, counted by its publisher"""
    media_time: int = 0
    """samples at 16 kHz since the session's first sample"""


class Result(Message, frozen=True, kw_only=True):
    """A message about the session at ``media_time``.

    Subclasses name other kinds of message of PROTOCOL.md and can be passed to ``results``.
    """

    @property
    def time_s(self) -> float:
        """Seconds since the session's first sample."""
        return self.media_time / MEDIA_RATE_HZ


class FapFrame(Result, frozen=True, kw_only=True):
    """The face at ``media_time``."""

    kind: ClassVar[str] = "fap-frame"

    values: Floats
    """68 values in FAP units, FAP 1 first"""
    shapes: dict[str, Floats] = {}
    """the same face as weights of each requested set of blendshapes, by name of the set"""

    def __post_init__(self) -> None:
        if len(self.values) != NUM_FAPS:
            raise ValueError(f"expected {NUM_FAPS} values, got {len(self.values)}")


class Shapes(Result, frozen=True, kw_only=True):
    """The face at ``media_time`` as weights of blendshapes, from a ``FapFrame``."""

    set: str
    """``arkit``, ``oculus`` or ``vrm``"""
    weights: Floats
    """0 to 1, in the order of ``SHAPE_NAMES``"""

    @property
    def by_name(self) -> dict[str, float]:
        """The weights by shape name."""
        return dict(zip(SHAPE_NAMES[self.set], self.weights, strict=True))


class Phone(Result, frozen=True, kw_only=True):
    """A recognized phone with its onset at ``media_time``; the same ``index`` revises it."""

    kind: ClassVar[str] = "phone"

    index: int
    """number of the phone within the session"""
    symbol: str
    """a phone of the session's language"""
    duration: int
    """samples at 16 kHz"""
    confidence: float
    """0 to 1"""
    final: bool
    """whether onset and duration are measured; otherwise the duration is an estimate"""

    @property
    def is_spoken(self) -> bool:
        """Whether the phone counts: its last version, unless it is a pause or withdrawn."""
        return self.final and self.duration > 0 and self.symbol != SILENCE


class Speech(Result, frozen=True, kw_only=True):
    """Speech starts or stops."""

    kind: ClassVar[str] = "speech"

    active: bool


class Sound(Result, frozen=True, kw_only=True):
    """The session's audio from ``media_time`` on."""

    kind: ClassVar[str] = "sound"

    pcm: bytes
    """16-bit integers, little-endian, 16 kHz, mono"""


class EndOfFaps(Message, frozen=True, kw_only=True):
    """The session's last FAP frame has been published."""

    kind: ClassVar[str] = "end-of-faps"


class Joined(Message, frozen=True, kw_only=True):
    """A publisher confirms that the subscriptions before this one are in effect."""

    kind: ClassVar[str] = "joined"

    publisher: str


class Event(Message, frozen=True, kw_only=True):
    """Control reports a change, such as ``session-closed`` or ``recorded``."""

    kind: ClassVar[str] = "event"

    name: str
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class ServiceState:
    """One service, as its last heartbeat described it."""

    service: str
    """``recognizer``, ``synthesizer``, ..."""
    instance: str
    role: str
    """``control``, ``worker`` (placed in sessions) or ``observer`` (takes part in all)"""
    state: str
    """``ready`` or ``draining``"""
    age_s: float
    """seconds since its last heartbeat"""
    clock_offset_ms: float
    """its clock minus control's"""
    endpoints: dict[str, str]
    metrics: dict[str, float]
    build: str = ""
    """version of kouxing; empty if unknown"""


@dataclass(frozen=True, kw_only=True)
class SessionFacts:
    """Facts that a session's workers state about their results."""

    language: str | None = None
    """language of the phones"""
    frame_rate_hz: float | None = None
    """FAP frames per second of media time"""
    delay_ms: float | None = None
    """from audio to its FAP frame"""
    lip_model: str | None = None
    """lip model of a face whose settings name none"""


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """Lateness of a live session's frames in the last 10 s."""

    p50_ms: float
    p95_ms: float
    worst_ms: float


@dataclass(frozen=True, kw_only=True)
class SessionState:
    """One session, as control knows it."""

    session: str
    state: str
    """``starting`` or ``open``"""
    age_s: float
    speaking: bool
    endpoints: dict[str, str]
    """addresses of its recognizer and synthesizer: ``audio``, ``phones``, ``faps``, ..."""
    workers: dict[str, str]
    """instance at each endpoint"""
    facts: SessionFacts
    lateness: Lateness | None = None
    """None if the session is not live, or had no frames in the last 10 s"""
    skipped_s: float = 0.0
    """duration of the audio that was skipped on a busy machine"""


@dataclass(frozen=True, kw_only=True)
class Status:
    """The state of a system."""

    services: list[ServiceState]
    sessions: list[SessionState]
    resting_face: dict[str, Any] = field(default_factory=dict)
    """settings of the face at rest that are in effect, as in ``Client.set_face``"""


M = TypeVar("M", bound=Message)
_ENCODER = msgspec.msgpack.Encoder()
_FIELDS_DECODER = msgspec.msgpack.Decoder(dict[str, Any])


def _to_floats(_type: object, data: object) -> array[float]:
    """Convert little-endian float32 to numbers."""
    if not isinstance(data, bytes):
        raise TypeError("expected bytes")
    values = array("f", data)
    if sys.byteorder == "big":
        values.byteswap()
    return values


def topic(kind: str, session: str) -> bytes:
    """Return the first part of a message, to which clients subscribe."""
    return f"{kind}/{session}/".encode()


def encode(kind: str, session: str, fields: Fields) -> list[bytes]:
    """Return the two parts of a message."""
    body = {"version": VERSION, "session": session, **fields}
    return [topic(kind, session), _ENCODER.encode(body)]


def kind_of(parts: list[bytes]) -> str:
    """Return the kind of a message."""
    return parts[0].partition(b"/")[0].decode("ascii", "replace")


def decode(parts: list[bytes]) -> tuple[str, Fields] | None:
    """Return the kind and the fields of a message; None if it is not a message of this version."""
    try:
        _, body = parts
        fields = {"session": "", "epoch": 0, "sequence": 0, **_FIELDS_DECODER.decode(body)}
    except (msgspec.MsgspecError, ValueError):
        return None
    return (kind_of(parts), fields) if fields.get("version") == VERSION else None


class Decoders:
    """Decodes messages of some classes."""

    def __init__(self, *classes: type[Message]) -> None:
        self._decoders = {
            cls.kind: msgspec.msgpack.Decoder(cls, dec_hook=_to_floats) for cls in classes
        }

    def decode(self, parts: list[bytes]) -> Message | None:
        """Return a message; None for other kinds, other versions and malformed messages."""
        decoder = self._decoders.get(kind_of(parts))
        if decoder is None or len(parts) != 2:
            return None
        try:
            message = decoder.decode(parts[1])
        except (msgspec.MsgspecError, ValueError):
            return None
        return message if message.version == VERSION else None
