"""Every message that crosses a socket; ``proto/PROTOCOL.md`` is the authority.

A message is two ZeroMQ parts: the topic ``<kind>/<session>/`` and a msgpack map of the fields
below. Adding an optional field with a default keeps the version; anything else is a new version.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from msgspec import Meta

from shared.faps import MASK_BYTES, NUM_FAPS

VERSION = 1
MEDIA_RATE_HZ = 16_000  # media time counts samples at this rate
MAX_AUDIO_BYTES = 64 * 1024
MAX_MESSAGE_BYTES = 1024 * 1024

SessionName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{0,64}$")]
Name = Annotated[str, Meta(min_length=1, max_length=128)]
Text = Annotated[str, Meta(max_length=2000)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Samples = Annotated[int, Meta(ge=0, le=2**53)]
Nanoseconds = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Unit = Annotated[str, Meta(pattern=r"^[a-z]{1,4}$")]
Endpoint = Annotated[str, Meta(max_length=256)]
FapValues = Annotated[bytes, Meta(min_length=4 * NUM_FAPS, max_length=4 * NUM_FAPS)]
FapMask = Annotated[bytes, Meta(min_length=MASK_BYTES, max_length=MASK_BYTES)]
EndpointMap = Annotated[dict[Name, Endpoint], Meta(max_length=16)]
MetricMap = Annotated[dict[Name, float], Meta(max_length=64)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """What every message carries."""

    kind: ClassVar[str]

    version: int = VERSION
    session: SessionName = ""  # empty where no session is concerned
    epoch: Count = 0  # counts the restarts of a session's recognizer
    sequence: Count = 0  # grows by one per sender, socket and session
    media_time: Samples = 0  # samples at 16 kHz since the session's first sample


# --- commands to control, and its answers -------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenSession(Message):
    """A client asks for a session; an empty session name lets control choose one."""

    kind: ClassVar[str] = "open"

    request: Name  # echoed in the answer; a repeated request gets the same answer
    encoding: Annotated[str, Meta(pattern="^(s16le|f32le)$")] = "s16le"
    sample_rate_hz: Annotated[int, Meta(ge=8000, le=48000)] = 16000
    num_channels: Annotated[int, Meta(ge=1, le=2)] = 1
    record: bool = False  # the driver writes a video named after the session
    paced: bool = True  # audio comes in real time; false: as fast as the services take it


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionOpened(Message):
    """The session exists; these are the sockets to use."""

    kind: ClassVar[str] = "opened"

    request: Name
    token: Name  # proves ownership in audio, end, flush and close
    audio: Endpoint  # ROUTER for the client's audio
    phones: Endpoint  # XPUB: phone, speech, sound
    faps: Endpoint  # XPUB: fap, end
    events: Endpoint  # XPUB: event


@dataclass(frozen=True, slots=True, kw_only=True)
class CloseSession(Message):
    """The client is done; everything of the session is let go."""

    kind: ClassVar[str] = "close"

    request: Name
    token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class FlushSession(Message):
    """Interruption: what is queued is dropped and the face returns to rest."""

    kind: ClassVar[str] = "flush"

    request: Name
    token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusRequest(Message):
    """Asks for the state of the whole system."""

    kind: ClassVar[str] = "status"

    request: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceState:
    """One service as its own loop last described it."""

    service: Name  # control, recognizer, synthesizer, driver, gateway
    instance: Name
    state: str  # ready, draining or lost
    age_s: float  # since its last heartbeat
    clock_offset_ms: float  # its clock minus control's
    endpoints: EndpointMap
    metrics: MetricMap


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionState:
    """One session as control knows it."""

    session: SessionName
    state: str  # starting or open
    age_s: float
    speaking: bool
    recognizer: str  # instance
    synthesizer: str  # instance


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport(Message):
    """The answer to a status request."""

    kind: ClassVar[str] = "report"

    request: Name
    services: Annotated[list[ServiceState], Meta(max_length=1000)]
    sessions: Annotated[list[SessionState], Meta(max_length=10000)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Done(Message):
    """A request was carried out."""

    kind: ClassVar[str] = "done"

    request: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class Error(Message):
    """Something was refused or failed; sent to whom it concerns, never closes anything else."""

    kind: ClassVar[str] = "error"

    code: Name  # see PROTOCOL.md
    text: Text
    request: Annotated[str, Meta(max_length=128)] = ""


# --- control and the services --------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat(Message):
    """A service's processing loop is alive; the first one registers it with control."""

    kind: ClassVar[str] = "heartbeat"

    service: Name
    instance: Name  # new at every start of the process
    state: Annotated[str, Meta(pattern="^(ready|draining)$")]
    sent_ns: Nanoseconds  # the sender's clock
    endpoints: EndpointMap = field(default_factory=dict)
    metrics: MetricMap = field(default_factory=dict)
    idle_s: Annotated[dict[SessionName, float], Meta(max_length=10000)] = field(
        default_factory=dict
    )  # seconds since each session last had input


@dataclass(frozen=True, slots=True, kw_only=True)
class HeartbeatSeen(Message):
    """Control's answer to a heartbeat: the other three of the four timestamps follow from it."""

    kind: ClassVar[str] = "seen"

    sent_ns: Nanoseconds  # echoed
    received_ns: Nanoseconds  # control's clock
    replied_ns: Nanoseconds  # control's clock


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSession(Message):
    """Control tells a service to serve a session (again, with a greater epoch, after a crash)."""

    kind: ClassVar[str] = "start"

    request: Name
    token: Name
    encoding: str
    sample_rate_hz: int
    num_channels: int
    record: bool
    paced: bool
    phone_input: Endpoint  # ROUTER of the synthesizer
    phones: Endpoint
    faps: Endpoint


@dataclass(frozen=True, slots=True, kw_only=True)
class StopSession(Message):
    """Control tells a service to let go of a session."""

    kind: ClassVar[str] = "stop"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlushNow(Message):
    """Control passes a flush on to the services."""

    kind: ClassVar[str] = "drop"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded(Message):
    """The driver finished a session's video."""

    kind: ClassVar[str] = "recorded"

    path: Text  # on the driver's host
    num_images: Count
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Event(Message):
    """Something that observers of control may want to know; numbered without gaps."""

    kind: ClassVar[str] = "event"

    number: Count
    name: Name  # see PROTOCOL.md
    detail: Text = ""


# --- audio, phones, FAPs -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class AudioChunk(Message):
    """PCM in the session's encoding; media_time is that of its first sample."""

    kind: ClassVar[str] = "audio"

    token: Name
    pcm: Annotated[bytes, Meta(max_length=MAX_AUDIO_BYTES)]  # interleaved, little-endian


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfAudio(Message):
    """No more audio will come: finish what is under way."""

    kind: ClassVar[str] = "finish"

    token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class Sound(Message):
    """The session's audio as the recognizer heard it: 16 kHz mono."""

    kind: ClassVar[str] = "sound"

    pcm: Annotated[bytes, Meta(max_length=4 * MAX_AUDIO_BYTES)]  # int16, little-endian


@dataclass(frozen=True, slots=True, kw_only=True)
class Speech(Message):
    """Voice activity began (active) or ended at media_time."""

    kind: ClassVar[str] = "speech"

    active: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class PhoneHeard(Message):
    """A recognised unit; media_time is its onset. The same index again revises it."""

    kind: ClassVar[str] = "phone"

    index: Count
    unit: Unit  # one of the 60 of Li 2011
    duration: Samples
    confidence: Annotated[float, Meta(ge=0, le=1)]
    final: bool  # false: the duration is an estimate


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Message):
    """Everything up to media_time has been heard."""

    kind: ClassVar[str] = "progress"

    level_db: Annotated[float, Meta(ge=-200, le=20)]  # RMS of the newest audio, full scale = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfPhones(Message):
    """The recognizer has said all of this session."""

    kind: ClassVar[str] = "spoken"


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledge(Message):
    """The receiver has every message of the session up to ``sequence``."""

    kind: ClassVar[str] = "ack"


@dataclass(frozen=True, slots=True, kw_only=True)
class FapFrame(Message):
    """One FAP frame: the face that belongs to the sound at media_time."""

    kind: ClassVar[str] = "fap"

    values: FapValues  # 68 float32, little-endian, in FAP units
    mask: FapMask  # bit i of the little-endian integer: FAP i + 1 is set


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfFaps(Message):
    """The last frame of the session went before this."""

    kind: ClassVar[str] = "end"


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined(Message):
    """Answers a subscription to ``joined/<session>/``: earlier ones of that peer are in effect."""

    kind: ClassVar[str] = "joined"

    publisher: Name  # differs between publishers: wait for as many as you connected to


MESSAGES: dict[str, type[Message]] = {
    cls.kind: cls
    for cls in (
        OpenSession,
        SessionOpened,
        CloseSession,
        FlushSession,
        StatusRequest,
        StatusReport,
        Done,
        Error,
        Heartbeat,
        HeartbeatSeen,
        StartSession,
        StopSession,
        FlushNow,
        Recorded,
        Event,
        AudioChunk,
        EndOfAudio,
        Sound,
        Speech,
        PhoneHeard,
        Progress,
        EndOfPhones,
        Acknowledge,
        FapFrame,
        EndOfFaps,
        Joined,
    )
}
