"""One message of every kind, as the golden bytes hold them."""

from __future__ import annotations

import numpy as np

from kouxing.shared.wire.audio import AudioChunk, Sound
from kouxing.shared.wire.control import (
    AllowedKey,
    Event,
    Heartbeat,
    HeartbeatReply,
    SessionInput,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.face import EndOfFaps, FaceSettings, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    FlushSession,
    Joined,
    OpenSession,
    ServiceState,
    SessionFacts,
    SessionMoved,
    SessionOpened,
    SessionState,
    StatusReport,
    StatusRequest,
)
from kouxing.shared.wire.speech import (
    Acknowledge,
    LipPositions,
    NewestFrame,
    Phone,
    Progress,
    Speech,
)

COMMON = {"session": "demo", "epoch": 1, "sequence": 7, "media_time": 16000}
FAPS = np.arange(68, dtype="<f4").tobytes()
MOUTH = np.arange(28, dtype="<f4").tobytes()
FACTS = SessionFacts(language="mandarin", frame_rate_hz=50.0, delay_ms=160.0, lip_model="learnt")
FACE = FaceSettings(
    lip_model="learnt",
    expressiveness=1.25,
    expressions={"joy": 0.5, "squint": 1.0},
    hold_s=2.5,
    shapes=["arkit", "vrm"],
)
FRAME = NewestFrame(sequence=50, media_time=16000, values=FAPS)
START = StartSession(
    session="demo",
    epoch=1,
    request="start-demo-1",
    token="t",
    encoding="s16le",
    sample_rate_hz=16000,
    num_channels=1,
    record=False,
    paced=True,
    facts=FACTS,
    endpoints={"phone_input": "tcp://127.0.0.1:5570"},
    face=FACE,
    speech_time=8000,
    client=b"\x01client",
    client_request="r1",
)

SAMPLES: tuple[Message, ...] = (
    OpenSession(
        session="demo", request="r1", sample_rate_hz=48000, num_channels=2, record=True, face=FACE
    ),
    SessionOpened(
        session="demo",
        request="r1",
        token="t",
        audio="tcp://127.0.0.1:5560",
        phones="tcp://127.0.0.1:5561",
        faps="tcp://127.0.0.1:5571",
        events="tcp://127.0.0.1:5551",
        facts=FACTS,
    ),
    SessionMoved(
        session="demo",
        epoch=2,
        audio="tcp://127.0.0.1:5562",
        phones="tcp://127.0.0.1:5563",
        faps="tcp://127.0.0.1:5571",
        next_sequence=101,
    ),
    CloseSession(session="demo", request="r2", token="t"),
    FlushSession(session="demo", request="r3", token="t"),
    SetFace(session="demo", request="r5", face=FACE),
    StatusRequest(request="r4"),
    StatusReport(
        request="r4",
        services=[
            ServiceState(
                service="recognizer",
                instance="recognizer-1",
                role="worker",
                state="ready",
                age_s=0.25,
                clock_offset_ms=-1.5,
                endpoints={"audio": "tcp://127.0.0.1:5560"},
                metrics={"chunk_ms_p50": 1.25},
            )
        ],
        sessions=[
            SessionState(
                session="demo",
                state="open",
                age_s=2.0,
                speaking=True,
                endpoints={"audio": "tcp://127.0.0.1:5560"},
                workers={"audio": "recognizer-1"},
                facts=FACTS,
            )
        ],
        next=2,
    ),
    Done(session="demo", request="r2"),
    Error(session="demo", code="busy", text="no worker has room", request="r2", retry_after_s=5.0),
    AudioChunk(**COMMON, token="t", pcm=b"\x00\x01\xff\x7f", last=True),  # type: ignore[arg-type]
    Sound(**COMMON, pcm=b"\x00\x01\xff\x7f"),  # type: ignore[arg-type]
    Speech(**COMMON, active=True),  # type: ignore[arg-type]
    Phone(
        **COMMON,  # type: ignore[arg-type]
        index=3,
        symbol="iang",
        duration=1600,
        confidence=0.5,
        final=False,
    ),
    LipPositions(**COMMON, values=MOUTH, delay=960, closure=0.75, lip_to_teeth=0.125),  # type: ignore[arg-type]
    FapFrame(
        **COMMON,  # type: ignore[arg-type]
        values=FAPS,
        mask=bytes([252] + [255] * 7 + [15]),
        shapes={"vrm": np.arange(12, dtype="<f4").tobytes()},
    ),
    EndOfFaps(**COMMON),  # type: ignore[arg-type]
    Joined(session="demo", publisher="p1"),
    Event(session="demo", sequence=4, name="recorded", detail="out/demo.mp4"),
    Progress(**COMMON, level_db=-20.5, zero_crossing_rate=0.25, pitch_hz=220.0, newest_frame=FRAME),  # type: ignore[arg-type]
    Acknowledge(**COMMON, newest_frame=FRAME),  # type: ignore[arg-type]
    Heartbeat(
        service="recognizer",
        instance="recognizer-1",
        role="worker",
        state="ready",
        sent_ns=1_700_000_000_000_000_000,
        endpoints={"audio": "tcp://127.0.0.1:5560"},
        needs=["phone_input"],
        facts=SessionFacts(language="mandarin"),
        load=0.5,
        metrics={"in_audio_chunk": 3.0},
        sessions={"demo": SessionInput(idle_s=0.5, sequence=100, media_time=16000)},
    ),
    HeartbeatReply(
        sent_ns=1,
        received_ns=2,
        replied_ns=3,
        control="control-1",
        keys={
            "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs": AllowedKey(name="laptop", roles=["client"])
        },
    ),
    START,
    SessionStarted(session="demo", request="start-demo-1", media_time=16000, start=START),
)
