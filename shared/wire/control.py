"""Messages between control and the services, and the events that control publishes."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from kouxing.shared.keys import MAX_KEYS, MAX_ROLES
from kouxing.shared.wire.message import (
    Address,
    ChosenLips,
    Count,
    Delay,
    Encoding,
    EndpointMap,
    ExpressionMap,
    ExpressivenessOrNone,
    FrameRate,
    HoldTime,
    LanguageName,
    LipsOrNone,
    Message,
    MetricMap,
    MouthProfile,
    Name,
    NameOrNone,
    Nanoseconds,
    NumChannels,
    SampleRate,
    Samples,
    SessionName,
    ShapeSets,
    Share,
    Text,
)

Role = Annotated[str, Meta(pattern="^(control|worker|observer)$")]
ServiceStatus = Annotated[str, Meta(pattern="^(ready|draining)$")]
SessionStatus = Annotated[str, Meta(pattern="^(starting|open)$")]


class EventName(StrEnum):
    """The names of events."""

    ERROR = "error"
    RECORDED = "recorded"
    SERVICE_LOST = "service-lost"
    SERVICE_READY = "service-ready"
    SESSION_CLOSED = "session-closed"
    SESSION_FLUSHED = "session-flushed"
    SESSION_MOVED = "session-moved"
    SESSION_OPENED = "session-opened"
    SPEECH_START = "speech-start"
    SPEECH_STOP = "speech-stop"


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusRequest(Message):
    """Asks for the state of the whole system, or of one session and its services."""

    request: Name
    after: Count = 0  # where the page before has ended


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceState:
    """One service as its own loop last described it."""

    service: Name  # recognizer, driver, ...
    instance: Name
    role: Role
    state: ServiceStatus
    age_s: float  # since its last heartbeat
    clock_offset_ms: float  # its clock minus control's
    endpoints: EndpointMap
    metrics: MetricMap


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionState:
    """One session as control knows it."""

    session: SessionName
    state: SessionStatus
    age_s: float
    speaking: bool
    endpoints: EndpointMap  # of the session's workers: audio, phones, faps, ...
    workers: Annotated[dict[Name, Name], Meta(max_length=16)]  # instance behind each endpoint
    language: LanguageName = ""  # of the phones


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusReport(Message):
    """The answer to a status request."""

    request: Name
    services: Annotated[list[ServiceState], Meta(max_length=10000)]
    sessions: Annotated[list[SessionState], Meta(max_length=10000)]
    next: Count = 0  # what to ask for the next page with; 0: this is the last


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionInput:
    """How far a service is with the input of one session."""

    idle_s: Annotated[float, Meta(ge=0)] = 0.0  # since its last input
    sequence: Count = 0  # newest audio message not needed any more; 0 where none is taken
    media_time: Samples = 0  # up to where the session's phones are final


@dataclass(frozen=True, slots=True, kw_only=True)
class Heartbeat(Message):
    """A service's processing loop is alive; the first heartbeat registers it with control."""

    service: Name
    instance: Name  # new at every start of the process
    role: Role  # a worker is placed in sessions, an observer takes part in all of them
    state: ServiceStatus
    sent_ns: Nanoseconds  # the sender's clock
    endpoints: EndpointMap = field(default_factory=dict)  # what it provides, by name
    needs: Annotated[list[Name], Meta(max_length=16)] = field(
        default_factory=list
    )  # names of endpoints it connects to
    language: LanguageName = ""  # of the phones that it recognises
    frame_rate_hz: FrameRate = 0.0  # of the FAP frames that it makes
    delay_ms: Delay = 0.0  # how much later than its sound it makes a FAP frame
    lips: LipsOrNone = ""  # the lip model that it uses until a client chooses one
    load: Share = 0.0  # of the last seconds in which its loop was busy
    metrics: MetricMap = field(default_factory=dict)
    sessions: Annotated[dict[SessionName, SessionInput], Meta(max_length=10000)] = field(
        default_factory=dict
    )  # those it takes part in


@dataclass(frozen=True, slots=True, kw_only=True)
class HeartbeatSeen(Message):
    """Control's answer to a heartbeat: the other three of the four timestamps follow from it."""

    sent_ns: Nanoseconds  # echoed
    received_ns: Nanoseconds  # control's clock
    replied_ns: Nanoseconds  # control's clock
    control: NameOrNone = ""  # instance of control; another than before has just started


@dataclass(frozen=True, slots=True, kw_only=True)
class AllowedKey:
    """Whose key it is and what its owner may do."""

    name: Name
    roles: Annotated[list[Name], Meta(max_length=MAX_ROLES)]


@dataclass(frozen=True, slots=True, kw_only=True)
class AllowedKeys(Message):
    """Control tells a service who may connect to its sockets; again when that changes."""

    keys: Annotated[dict[Name, AllowedKey], Meta(max_length=MAX_KEYS)]  # by public key


@dataclass(frozen=True, slots=True, kw_only=True)
class StartSession(Message):
    """Control tells a service to serve a session (again, with a greater epoch, after a crash).

    Phones whose middle lies before ``media_time`` are known already. A recognizer sends this back
    to a control that has just started, which knows the session from it.
    """

    request: Name
    token: Name
    encoding: Encoding
    sample_rate_hz: SampleRate
    num_channels: NumChannels
    record: bool
    paced: bool
    language: LanguageName  # of the phones
    endpoints: EndpointMap  # of the session's workers: audio, phones, phone_input, faps, ...
    delay_ms: Delay = 0.0  # how much later than its sound a FAP frame is made
    lips: LipsOrNone = ""  # the lip model that moves the mouth at first
    voice: MouthProfile = b""  # of the speaker, for the lip model
    expressiveness: ExpressivenessOrNone = 0.0  # that was chosen; 0: none was
    expressions: ExpressionMap = field(default_factory=dict)  # that the face shows at first
    hold_s: HoldTime = 0.0  # that these stay before they fade
    shapes: ShapeSets = field(default_factory=list)  # sets that are published beside FAP frames
    client: Address = b""  # what the client calls itself at control
    client_key: NameOrNone = ""  # its public key; empty where all is plain
    client_request: NameOrNone = ""  # its open-session
    speech_time: Samples = 0  # when the speech began that is under way; 0: nobody speaks, or knows


@dataclass(frozen=True, slots=True, kw_only=True)
class StopSession(Message):
    """Control tells a service to forget a session."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlushNow(Message):
    """Control passes a flush on to the services."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UseLips(Message):
    """Control passes the choice of a lip model on to the services."""

    lips: ChosenLips


@dataclass(frozen=True, slots=True, kw_only=True)
class Recorded(Message):
    """The driver finished a session's video."""

    path: Text  # on the driver's host
    num_images: Count
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Event(Message):
    """Something changed; numbered without gaps."""

    number: Count
    name: Name  # an EventName, or one of a later build
    detail: Text = ""
