"""Messages between a client and control, and the confirmation of subscriptions."""

from enum import StrEnum
from typing import Annotated

from msgspec import Meta, Struct, field

from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.message import (
    Count,
    Endpoint,
    EndpointMap,
    Message,
    Milliseconds,
    Name,
    Seconds,
    SessionName,
    Text,
)

Encoding = Annotated[str, Meta(pattern="^(s16le|f32le)$")]
SampleRate = Annotated[int, Meta(ge=8000, le=48000)]  # Hz
NumChannels = Annotated[int, Meta(ge=1, le=2)]
MouthProfile = Annotated[bytes, Meta(max_length=MAX_MOUTH_PROFILE_BYTES)]
Role = Annotated[str, Meta(pattern="^(control|worker|observer)$")]
ServiceStatus = Annotated[str, Meta(pattern="^(ready|draining)$")]
SessionStatus = Annotated[str, Meta(pattern="^(starting|open)$")]
MetricMap = Annotated[dict[Name, float], Meta(max_length=64)]


class ErrorCode(StrEnum):
    """The codes of ``error`` messages."""

    BAD_MESSAGE = "bad-message"
    BAD_AUDIO = "bad-audio"
    BAD_FACE = "bad-face"
    BAD_LANGUAGE = "bad-language"
    BAD_MOUTH_PROFILE = "bad-mouth-profile"
    BAD_TOKEN = "bad-token"  # noqa: S105 - no password
    BUSY = "busy"
    FINISHED = "finished"
    NO_LINK = "no-link"
    NO_SERVICE = "no-service"
    NO_VIDEO = "no-video"
    NOT_ALLOWED = "not-allowed"
    SESSION_EXISTS = "session-exists"
    TIMEOUT = "timeout"
    TOO_MANY_SERVICES = "too-many-services"
    TOO_MANY_SESSIONS = "too-many-sessions"
    UNKNOWN_SESSION = "unknown-session"


class SessionFacts(Struct, frozen=True, kw_only=True):
    """Facts about a session's results; each of its workers states some facts."""

    language: Name | None = None  # language of the phones
    frame_rate_hz: Annotated[float, Meta(gt=0, le=1000)] | None = None  # FAP frames per second
    delay_ms: Annotated[float, Meta(ge=0, le=1000)] | None = None  # from audio to its FAP frame
    lip_model: Name | None = None  # used unless the face settings name one


class Lateness(Struct, frozen=True, kw_only=True):
    """Lateness of the frames that left a live session's synthesizer in the last 10 s."""

    p50_ms: Milliseconds
    p95_ms: Milliseconds
    worst_ms: Milliseconds


class OpenSession(Message, frozen=True, kw_only=True):
    """A client asks for a session; if the session name is empty, control chooses one."""

    request: Name  # repeated in the answer
    encoding: Encoding = "s16le"
    sample_rate_hz: SampleRate = 16000
    num_channels: NumChannels = 1
    record: bool = False  # the driver writes a video named after the session
    paced: bool = True  # audio arrives in real time; false: as fast as the services accept it
    mouth_profile: MouthProfile | None = None  # the speaker's, for a lip model that uses the audio
    language: Name | None = None  # spoken: "auto", a code or a name; None: the recognizer's
    face: FaceSettings = field(default_factory=FaceSettings)


class SessionOpened(Message, frozen=True, kw_only=True):
    """The session exists; connect to these endpoints."""

    request: Name
    token: Name  # proves ownership when the client sends audio, flushes or closes
    audio: Endpoint  # ROUTER for the client's audio
    phones: Endpoint  # XPUB: phone, lip-positions, speech, sound
    faps: Endpoint  # XPUB: fap-frame, end-of-faps
    events: Endpoint  # XPUB: event, session-moved
    facts: SessionFacts


class SessionMoved(Message, frozen=True, kw_only=True):
    """Other workers serve the session from now on; ``epoch`` is the new one.

    Sent to the client, and published for all followers of the session.
    """

    audio: Endpoint
    phones: Endpoint
    faps: Endpoint
    next_sequence: Count | None = None  # first audio message to resend; None: the recognizer stays


class CloseSession(Message, frozen=True, kw_only=True):
    """The session is over; the services delete its state.

    Sent by a client to control, and by control to the services.
    """

    request: Name | None = None  # None: no answer is needed
    token: Name | None = None  # a client must give it


class FlushSession(Message, frozen=True, kw_only=True):
    """Interrupts: audio not yet shown is dropped and the face returns to rest.

    Sent by a client to control, and by control to the services.
    """

    request: Name
    token: Name


class StatusRequest(Message, frozen=True, kw_only=True):
    """Asks for the state of the whole system, or of one session and its services."""

    request: Name
    after: Count = 0  # ``next`` of the page before


class ServiceState(Struct, frozen=True, kw_only=True):
    """One service, from its newest heartbeat."""

    service: Name  # recognizer, driver, ...
    instance: Name
    role: Role
    state: ServiceStatus
    age_s: float  # since its newest heartbeat
    clock_offset_ms: float  # its clock minus control's
    endpoints: EndpointMap
    metrics: MetricMap
    build: Text = ""  # version of kouxing


class SessionState(Struct, frozen=True, kw_only=True):
    """One session."""

    session: SessionName
    state: SessionStatus
    age_s: float
    speaking: bool
    endpoints: EndpointMap  # the session's workers: audio, phones, faps, ...
    workers: Annotated[dict[Name, Name], Meta(max_length=16)]  # instance behind each endpoint
    facts: SessionFacts
    lateness: Lateness | None = None  # None: not live, or no frames in the last 10 s
    skipped_s: Seconds = 0.0  # total duration of the audio skipped on a busy machine


class StatusReport(Message, frozen=True, kw_only=True):
    """The answer to a status request."""

    request: Name
    services: Annotated[list[ServiceState], Meta(max_length=10000)]
    sessions: Annotated[list[SessionState], Meta(max_length=10000)]
    next: Count | None = None  # ``after`` of the request for the next page; None: the last page
    resting_face: FaceSettings | None = None  # settings of the face at rest that are in effect


class Done(Message, frozen=True, kw_only=True):
    """Control has carried out a request."""

    request: Name


class Error(Message, frozen=True, kw_only=True):
    """A request or message was refused.

    The kind and these fields exist in every version of the protocol. A message of another version
    is answered in that version, so that its sender can read why it was refused.
    """

    code: Name  # an ErrorCode, or one of a later build
    text: Text
    request: Name | None = None
    retry_after_s: Annotated[Seconds, Meta(le=3600)] | None = None


class Joined(Message, frozen=True, kw_only=True):
    """A publisher's answer to a subscription to ``joined/<session>/``.

    The subscriber's earlier subscriptions are in effect.
    """

    publisher: Name  # differs between publishers; wait for as many as you connected to
