"""Every kind of message by its name, and the endpoints at which messages are published."""

from __future__ import annotations

from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk, Sound
from kouxing.shared.wire.control import (
    Event,
    Heartbeat,
    HeartbeatReply,
    SessionStarted,
    StartSession,
    StopSession,
)
from kouxing.shared.wire.face import EndOfFaps, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    FlushSession,
    Joined,
    OpenSession,
    SessionMoved,
    SessionOpened,
    StatusReport,
    StatusRequest,
)
from kouxing.shared.wire.speech import AcknowledgePhones, Lips, Phone, Progress, ResumeFace, Speech

MESSAGES: dict[str, type[Message]] = {
    cls.kind: cls
    for cls in (
        OpenSession,
        SessionOpened,
        SessionMoved,
        CloseSession,
        FlushSession,
        SetFace,
        StatusRequest,
        StatusReport,
        Done,
        Error,
        AudioChunk,
        AcknowledgeAudio,
        Sound,
        Speech,
        Phone,
        Lips,
        FapFrame,
        EndOfFaps,
        Joined,
        Event,
        Progress,
        ResumeFace,
        AcknowledgePhones,
        Heartbeat,
        HeartbeatReply,
        StartSession,
        SessionStarted,
        StopSession,
    )
}

# The session's endpoint that publishes each kind.
PUBLISHER_OF: dict[type[Message], str] = {
    **dict.fromkeys((Phone, Lips, Speech, Sound), "phones"),
    **dict.fromkeys((FapFrame, EndOfFaps), "faps"),
}
