"""The messages that a client reads and writes; PROTOCOL.md describes them."""

from __future__ import annotations

import sys
from array import array
from typing import Annotated, Any, ClassVar

import msgspec

from kouxing_client.field_types import (
    MAX_AUDIO_BYTES,
    Count,
    EndpointMap,
    FapMask,
    FapValues,
    MetricMap,
    Milliseconds,
    Name,
    PhoneSymbol,
    Probability,
    Role,
    Samples,
    Seconds,
    ServiceStatus,
    SessionName,
    SessionStatus,
    ShapeMap,
    Text,
    Version,
)

VERSION = 3
MEDIA_RATE_HZ = 16000
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
    published_at: ClassVar[str] = ""  # name of the worker's endpoint; empty: not published there

    version: Version = VERSION
    session: SessionName = ""
    """name of the session; empty: the message concerns no session"""
    epoch: Count = 0
    """placement of the session; it grows each time the session moves to another process"""
    sequence: Count = 0
    """sequence number of the message, counted by its sender for each socket and session"""
    media_time: Samples = 0
    """samples at 16 kHz since the session's first sample"""


class Result(Message, frozen=True, kw_only=True):
    """A message about the session at ``media_time``.

    Subclasses name other kinds of message of PROTOCOL.md and can be passed to ``results``.
    """

    published_at: ClassVar[str] = "phones"

    @property
    def time_s(self) -> float:
        """Seconds since the session's first sample."""
        return self.media_time / MEDIA_RATE_HZ


class FapFrame(Result, frozen=True, kw_only=True):
    """The face that belongs to the audio at media_time."""

    kind: ClassVar[str] = "fap-frame"
    published_at: ClassVar[str] = "faps"

    packed_values: FapValues = msgspec.field(name="values")
    """``values`` as little-endian float32"""
    mask: FapMask
    """bit i of the little-endian integer: FAP i + 1 is set"""
    packed_shapes: ShapeMap = msgspec.field(name="shapes", default_factory=dict)
    """``shapes`` as little-endian float32"""

    def __post_init__(self) -> None:
        if any(len(weights) % 4 for weights in self.packed_shapes.values()):
            raise ValueError("shapes must have 4 bytes for each weight")

    @property
    def values(self) -> array[float]:
        """68 values in FAP units, FAP 1 first."""
        return _unpack(self.packed_values)

    @property
    def shapes(self) -> dict[str, array[float]]:
        """The same face as weights of each requested set of blendshapes, by name of the set."""
        return {name: _unpack(weights) for name, weights in self.packed_shapes.items()}


class Shapes(Result, frozen=True, kw_only=True):
    """The face at ``media_time`` as weights of blendshapes, from a ``FapFrame``."""

    set: str
    """``arkit``, ``oculus`` or ``vrm``"""
    packed_weights: bytes
    """``weights`` as little-endian float32"""

    @property
    def weights(self) -> array[float]:
        """0 to 1, in the order of ``SHAPE_NAMES``."""
        return _unpack(self.packed_weights)

    @property
    def by_name(self) -> dict[str, float]:
        """The weights by shape name."""
        return dict(zip(SHAPE_NAMES[self.set], self.weights, strict=True))


class EndOfFaps(Message, frozen=True, kw_only=True):
    """The session has no more FAP frames."""

    kind: ClassVar[str] = "end-of-faps"
    published_at: ClassVar[str] = "faps"


class Phone(Result, frozen=True, kw_only=True):
    """A recognized phone; media_time is its onset. A message with the same index revises it."""

    kind: ClassVar[str] = "phone"

    index: Count
    """number of the phone within the session"""
    symbol: PhoneSymbol
    """a phone of the session's language"""
    duration: Samples
    """samples at 16 kHz"""
    confidence: Probability
    final: bool
    """whether onset and duration are measured; otherwise the duration is an estimate"""

    @property
    def is_spoken(self) -> bool:
        """Whether the phone counts: its last version, unless it is a pause or withdrawn."""
        return self.final and self.duration > 0 and self.symbol != SILENCE


class Speech(Result, frozen=True, kw_only=True):
    """Voice activity started (active) or ended at media_time."""

    kind: ClassVar[str] = "speech"

    active: bool


class Sound(Result, frozen=True, kw_only=True):
    """The session's audio as the recognizer reads it: 16 kHz mono."""

    kind: ClassVar[str] = "sound"

    pcm: Annotated[bytes, msgspec.Meta(max_length=4 * MAX_AUDIO_BYTES)]
    """16-bit integers, little-endian"""


class Joined(Message, frozen=True, kw_only=True):
    """A publisher's answer to a subscription to ``joined/<session>/``.

    The subscriber's earlier subscriptions are in effect.
    """

    kind: ClassVar[str] = "joined"

    publisher: Name
    """differs between publishers; wait for as many as you connected to"""
    endpoint: Name | None = None
    """name of the publisher's endpoint: ``phones`` or ``faps``; None: unknown"""
    repeats: bool = False
    """whether the publisher next repeats its messages, also those that arrived before this one"""


class Event(Message, frozen=True, kw_only=True):
    """Something happened. A service sends it to control, which numbers and publishes it."""

    kind: ClassVar[str] = "event"

    name: Name
    """such as ``session-closed`` or ``recorded``"""
    detail: Text = ""
    session_id: Name | None = None
    """as in ``session-opened``: earlier sessions of the same name have other ids"""


class ServiceState(msgspec.Struct, frozen=True, kw_only=True):
    """One service, from its newest heartbeat."""

    service: Name
    """``recognizer``, ``synthesizer``, ..."""
    instance: Name
    role: Role
    """``control``, ``worker`` (placed in sessions) or ``observer`` (takes part in all)"""
    state: ServiceStatus
    """``ready`` or ``draining``"""
    age_s: float
    """seconds since its newest heartbeat"""
    clock_offset_ms: float
    """its clock minus control's"""
    endpoints: EndpointMap
    metrics: MetricMap
    build: Text = ""
    """version of kouxing; empty if unknown"""


class SessionFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a session's results; each of its workers states some facts."""

    language: Name | None = None
    """language of the phones"""
    frame_rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] | None = None
    """FAP frames per second of media time"""
    delay_ms: Annotated[float, msgspec.Meta(ge=0, le=1000)] | None = None
    """from audio to its FAP frame"""
    lip_model: Name | None = None
    """lip model of a face whose settings name none"""
    expressiveness: Annotated[float, msgspec.Meta(ge=0.5, le=2)] | None = None
    """size of the mouth movements of a face whose settings have none"""
    feeling: Probability | None = None
    """how strongly a face without this setting shows the emotion in the voice"""


class Lateness(msgspec.Struct, frozen=True, kw_only=True):
    """Lateness of the frames that left a live session's synthesizer in the last 10 s."""

    p50_ms: Milliseconds
    p95_ms: Milliseconds
    worst_ms: Milliseconds


class SessionState(msgspec.Struct, frozen=True, kw_only=True):
    """One session."""

    session: SessionName
    state: SessionStatus
    """``starting`` or ``open``"""
    age_s: float
    speaking: bool
    endpoints: EndpointMap
    """addresses of its recognizer and synthesizer: ``audio``, ``phones``, ``faps``, ..."""
    workers: Annotated[dict[Name, Name], msgspec.Meta(max_length=16)]
    """instance at each endpoint"""
    facts: SessionFacts
    lateness: Lateness | None = None
    """None if the session is not live, or had no frames in the last 10 s"""
    skipped_s: Seconds = 0.0
    """duration of the audio that was skipped on a busy machine"""
    session_id: Name | None = None
    """as in ``session-opened``"""


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a system."""

    services: list[ServiceState]
    sessions: list[SessionState]
    resting_face: dict[str, Any] = {}
    """settings of the face at rest that are in effect, as in ``Client.set_face``"""


_ENCODER = msgspec.msgpack.Encoder()
_FIELDS_DECODER = msgspec.msgpack.Decoder(dict[str, Any])


def _unpack(data: bytes) -> array[float]:
    """Convert little-endian float32 to numbers."""
    values = array("f", data)
    if sys.byteorder == "big":
        values.byteswap()
    return values


def topic(kind: str, session: str) -> bytes:
    """Return the first part of a message, to which clients subscribe.

    It ends in a slash, so no topic is a prefix of another.
    """
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
        defaults = {"version": VERSION, "session": "", "epoch": 0, "sequence": 0}
        fields = defaults | _FIELDS_DECODER.decode(body)
    except (msgspec.MsgspecError, ValueError):
        return None
    return (kind_of(parts), fields) if fields["version"] == VERSION else None


class Decoders:
    """Decodes messages of some classes."""

    def __init__(self, *classes: type[Message]) -> None:
        self._decoders = {cls.kind.encode(): msgspec.msgpack.Decoder(cls) for cls in classes}

    def decode(self, parts: list[bytes]) -> Message | None:
        """Return a message; None for other kinds, other versions and malformed messages."""
        decoder = self._decoders.get(parts[0].partition(b"/")[0])
        if decoder is None or len(parts) != 2:
            return None
        try:
            message = decoder.decode(parts[1])
        except (msgspec.MsgspecError, ValueError):
            return None
        return message if message.version == VERSION else None
