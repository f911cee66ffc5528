"""The messages of a client: to control and back, and its audio."""

import hashlib
from enum import StrEnum
from typing import Annotated

from kouxing_client.audio import SAMPLE_BYTES
from kouxing_client.field_types import (
    MAX_AUDIO_BYTES,
    Count,
    Endpoint,
    Name,
    Seconds,
    Text,
    full_match,
)
from kouxing_client.messages import ServiceState, SessionFacts, SessionState
from kouxing_client.options import MAX_CHANNELS, MAX_RATE_HZ, MIN_RATE_HZ
from msgspec import Meta, field

from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.message import RegisteredMessage

Encoding = Annotated[str, full_match(f"({'|'.join(SAMPLE_BYTES)})")]
SampleRate = Annotated[int, Meta(ge=MIN_RATE_HZ, le=MAX_RATE_HZ)]
NumChannels = Annotated[int, Meta(ge=1, le=MAX_CHANNELS)]
MouthProfile = Annotated[bytes, Meta(max_length=MAX_MOUTH_PROFILE_BYTES)]


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
    SHORT_VIDEO = "short-video"
    TIMEOUT = "timeout"
    TOO_MANY_SERVICES = "too-many-services"
    TOO_MANY_SESSIONS = "too-many-sessions"
    UNKNOWN_SESSION = "unknown-session"


class OpenSession(RegisteredMessage, frozen=True, kw_only=True):
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


def session_id_of(token: str) -> str:
    """Return the public id of the session with this secret token."""
    return hashlib.sha256(token.encode()).hexdigest()[:16]


class SessionOpened(RegisteredMessage, frozen=True, kw_only=True):
    """The session exists; connect to these endpoints."""

    request: Name
    token: Name  # proves ownership when the client sends audio, flushes or closes
    audio: Endpoint  # ROUTER for the client's audio
    phones: Endpoint  # XPUB: phone, lip-positions, speech, sound
    faps: Endpoint  # XPUB: fap-frame, end-of-faps
    events: Endpoint  # XPUB: event, session-moved
    facts: SessionFacts
    session_id: Name | None = None  # differs from the ids of other sessions with the same name


class SessionMoved(RegisteredMessage, frozen=True, kw_only=True):
    """Other workers serve the session from now on; ``epoch`` is the new one.

    Sent to the client, and published for all followers of the session.
    """

    audio: Endpoint
    phones: Endpoint
    faps: Endpoint
    next_sequence: Count | None = None  # first audio message to resend; None: the recognizer stays
    session_id: Name | None = None  # as in session-opened


class AudioChunk(RegisteredMessage, frozen=True, kw_only=True):
    """PCM in the session's encoding; media_time is the time of its first sample."""

    token: Name
    pcm: Annotated[bytes, Meta(max_length=MAX_AUDIO_BYTES)] = b""  # interleaved, little-endian
    last: bool = False  # no more audio follows: finish the session
    acknowledge: bool = False  # the client reads acknowledge messages and resends lost messages


class CloseSession(RegisteredMessage, frozen=True, kw_only=True):
    """The session has ended; the services delete its state.

    Sent by a client to control, and by control to the services.
    """

    request: Name | None = None  # None: no answer is needed
    token: Name | None = None  # a client must give it


class FlushSession(RegisteredMessage, frozen=True, kw_only=True):
    """Interrupts: audio not yet shown is dropped and the face returns to rest.

    ``sequence`` is the number of the client's newest audio message. Sent by a client to control,
    and by control to the services.
    """

    request: Name
    token: Name


class StatusRequest(RegisteredMessage, frozen=True, kw_only=True):
    """Asks for the state of the whole system, or of one session and its services."""

    request: Name
    after: Count = 0  # ``next`` of the page before


class StatusReport(RegisteredMessage, frozen=True, kw_only=True):
    """The answer to a status request."""

    request: Name
    services: Annotated[list[ServiceState], Meta(max_length=10000)]
    sessions: Annotated[list[SessionState], Meta(max_length=10000)]
    next: Count | None = None  # ``after`` of the request for the next page; None: the last page
    resting_face: FaceSettings | None = None  # settings of the face at rest that are in effect


class Done(RegisteredMessage, frozen=True, kw_only=True):
    """Control has carried out a request."""

    request: Name


class Error(RegisteredMessage, frozen=True, kw_only=True):
    """A request or message was rejected.

    The kind and these fields exist in every version of the protocol. A message of another version
    is answered in that version, so that its sender can read why it was rejected.
    """

    code: Name  # an ErrorCode, or one of a later build
    text: Text
    request: Annotated[str, Meta(max_length=128)] | None = None  # version 2 sends ""
    retry_after_s: Annotated[Seconds, Meta(le=3600)] | None = None
