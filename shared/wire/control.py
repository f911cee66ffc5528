"""Messages between control and the services, and the names of events."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from kouxing_client.field_types import (
    Count,
    EndpointMap,
    MetricMap,
    Name,
    Probability,
    Role,
    Samples,
    Seconds,
    ServiceStatus,
    SessionName,
    Text,
)
from kouxing_client.messages import Lateness, SessionFacts
from msgspec import Meta, Struct, field

from kouxing.shared.fast_record import replace
from kouxing.shared.settings.keys import MAX_KEYS, MAX_ROLES
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.message import RegisteredMessage
from kouxing.shared.wire.session import OpenSession, session_id_of


class EventName(StrEnum):
    """The names of ``event`` messages."""

    AUDIO_SKIPPED = "audio-skipped"
    ERROR = "error"
    LAUGHTER_START = "laughter-start"
    LAUGHTER_STOP = "laughter-stop"
    RECORDED = "recorded"
    SERVICE_LOST = "service-lost"
    SERVICE_READY = "service-ready"
    SESSION_CLOSED = "session-closed"
    SESSION_FLUSHED = "session-flushed"
    SESSION_MOVED = "session-moved"
    SESSION_OPENED = "session-opened"
    SPEECH_START = "speech-start"
    SPEECH_STOP = "speech-stop"


class SessionProgress(Struct, frozen=True, kw_only=True):
    """Progress of a service in one session."""

    idle_s: Seconds = 0.0  # since the session's last input
    last_droppable_sequence: Count = 0  # newest audio that a replacement recognizer does not need
    final_until: Samples = 0  # media time up to which the session's phones are final
    lateness: Lateness | None = None  # lateness of a synthesizer's frames; None: no live frames
    skipped_s: Seconds = 0.0  # total duration of the audio skipped by a slow service


class Heartbeat(RegisteredMessage, frozen=True, kw_only=True):
    """A service's loop is running; the first heartbeat registers the service with control."""

    service: Name
    instance: Name  # new at every start of the process
    role: Role  # a worker is placed in sessions, an observer takes part in all of them
    state: ServiceStatus
    sent_ns: int  # the sender's clock, which may be wrong
    endpoints: EndpointMap = field(default_factory=dict)  # endpoints that it provides, by name
    # names of the endpoints that it connects to
    needs: Annotated[list[Name], Meta(max_length=16)] = field(default_factory=list)
    facts: SessionFacts = field(default_factory=SessionFacts)
    # additional languages that its sessions may choose
    languages: Annotated[list[Name], Meta(max_length=64)] = field(default_factory=list)
    # lip models that its sessions may choose; empty: unknown
    lip_models: Annotated[list[Name], Meta(max_length=64)] = field(default_factory=list)
    build: Text = ""  # version of kouxing
    load: Probability = 0.0  # fraction of the last 2 s in which its loop was busy
    metrics: MetricMap = field(default_factory=dict)
    # sessions of the service
    sessions: Annotated[dict[SessionName, SessionProgress], Meta(max_length=10000)] = field(
        default_factory=dict
    )


class AllowedKey(Struct, frozen=True, kw_only=True):
    """The name of a key and what its owner may do."""

    name: Name
    roles: Annotated[list[Name], Meta(max_length=MAX_ROLES)]


class HeartbeatReply(RegisteredMessage, frozen=True, kw_only=True):
    """Control's answer to a heartbeat; the four timestamps give the offset of the clocks."""

    sent_ns: int  # as in the heartbeat
    received_ns: int  # control's clock
    replied_ns: int  # control's clock
    control_instance: Name  # generated when control starts; when it changes, control has restarted
    keys: Annotated[dict[Name, AllowedKey], Meta(max_length=MAX_KEYS)] | None = (
        None  # keys that may connect to the worker, by public key; None: as before
    )
    # kinds of worker that every session needs but that are not running
    missing: Annotated[list[Name], Meta(max_length=16)] = field(default_factory=list)
    idle_limit_s: Seconds = 60.0  # duration without audio after which control closes a session


class StartSession(RegisteredMessage, frozen=True, kw_only=True):
    """Control asks a service to serve a session; again with a greater epoch after a move."""

    request: Name
    token: Name
    opening: OpenSession  # the client's request, with the face settings in effect now
    facts: SessionFacts
    endpoints: EndpointMap  # the session's workers: audio, phones, phone_input, faps, ...
    final_until: Samples = 0  # media time before which all phones are known
    speech_time: Samples | None = None  # start of the speech in progress; None: silence, or unknown
    client: Annotated[bytes, Meta(max_length=255)] = b""  # its routing id at control
    client_key: Name | None = None  # its public key; None: the system is insecure

    @property
    def session_id(self) -> str:
        """Public id of the session; other sessions with the same name have other ids."""
        return session_id_of(self.token)

    def with_face(self, face: FaceSettings) -> StartSession:
        """Return this message with other face settings."""
        return replace(self, opening=replace(self.opening, face=face))


class SessionStarted(RegisteredMessage, frozen=True, kw_only=True):
    """A service serves a session."""

    request: Name  # request of the start-session
    final_until: Samples = 0  # synthesizer: media time up to which the session's phones are final
    start: StartSession | None = None  # for a restarted control, which does not have the session
