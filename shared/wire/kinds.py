"""Every kind of message by its name, and the endpoints at which messages are published."""

from __future__ import annotations

from kouxing.shared.wire.audio import AudioChunk, EndOfAudio, Sound
from kouxing.shared.wire.control import (
    AllowedKeys,
    Event,
    FlushNow,
    Heartbeat,
    HeartbeatSeen,
    Recorded,
    StartSession,
    StatusReport,
    StatusRequest,
    StopSession,
    UseLips,
)
from kouxing.shared.wire.face import EndOfFaps, FapFrame, Shapes
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    AddShapes,
    ChooseExpressiveness,
    ChooseLips,
    CloseSession,
    Done,
    Error,
    Express,
    FlushSession,
    Joined,
    OpenSession,
    SessionMoved,
    SessionOpened,
)
from kouxing.shared.wire.speech import (
    Acknowledge,
    EndOfPhones,
    Lips,
    Phone,
    Progress,
    ResumeFace,
    Speech,
    Stalled,
)

MESSAGES: dict[str, type[Message]] = {
    cls.kind: cls
    for cls in (
        OpenSession,
        SessionOpened,
        SessionMoved,
        CloseSession,
        FlushSession,
        ChooseLips,
        StatusRequest,
        StatusReport,
        Done,
        Error,
        Heartbeat,
        HeartbeatSeen,
        StartSession,
        StopSession,
        FlushNow,
        UseLips,
        Recorded,
        Event,
        AudioChunk,
        EndOfAudio,
        Sound,
        Speech,
        Phone,
        Lips,
        Progress,
        EndOfPhones,
        Acknowledge,
        FapFrame,
        EndOfFaps,
        Joined,
        Express,
        ChooseExpressiveness,
        AllowedKeys,
        Stalled,
        ResumeFace,
        Shapes,
        AddShapes,
    )
}

# The session's endpoint that publishes each kind.
PUBLISHER_OF: dict[type[Message], str] = {
    **dict.fromkeys((Phone, Lips, Speech, Sound), "phones"),
    **dict.fromkeys((FapFrame, Shapes, EndOfFaps), "faps"),
}
