"""One message of every kind, as the golden bytes hold them."""

from __future__ import annotations

import numpy as np

from kouxing.shared.wire.audio import AudioChunk, EndOfAudio, Sound
from kouxing.shared.wire.control import (
    AllowedKey,
    AllowedKeys,
    Event,
    FlushNow,
    Heartbeat,
    HeartbeatSeen,
    Recorded,
    ServiceState,
    SessionInput,
    SessionState,
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

COMMON = {"session": "demo", "epoch": 1, "sequence": 7, "media_time": 16000}
FAPS = np.arange(68, dtype="<f4").tobytes()
MOUTH = np.arange(28, dtype="<f4").tobytes()

SAMPLES: tuple[Message, ...] = (
    OpenSession(session="demo", request="r1", sample_rate_hz=48000, num_channels=2, record=True),
    SessionOpened(
        session="demo",
        request="r1",
        token="t",
        audio="tcp://127.0.0.1:5560",
        phones="tcp://127.0.0.1:5561",
        faps="tcp://127.0.0.1:5571",
        events="tcp://127.0.0.1:5551",
        language="mandarin",
        frame_rate_hz=50.0,
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
    ChooseLips(session="demo", request="r3", token="t", lips="learnt"),
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
            )
        ],
    ),
    Done(session="demo", request="r2"),
    Error(session="demo", code="unknown-session", text="there is no session", request="r2"),
    Heartbeat(
        service="recognizer",
        instance="recognizer-1",
        role="worker",
        state="ready",
        sent_ns=1_700_000_000_000_000_000,
        endpoints={"audio": "tcp://127.0.0.1:5560"},
        needs=["phone_input"],
        language="mandarin",
        metrics={"in_audio_chunk": 3.0},
        sessions={"demo": SessionInput(idle_s=0.5, sequence=100)},
    ),
    HeartbeatSeen(sent_ns=1, received_ns=2, replied_ns=3),
    StartSession(
        session="demo",
        epoch=1,
        request="start-demo-1",
        token="t",
        encoding="s16le",
        sample_rate_hz=16000,
        num_channels=1,
        record=False,
        paced=True,
        language="mandarin",
        endpoints={"phone_input": "tcp://127.0.0.1:5570"},
        delay_ms=160.0,
    ),
    StopSession(session="demo", epoch=1),
    FlushNow(session="demo", epoch=1),
    UseLips(session="demo", epoch=1, lips="learnt"),
    Recorded(session="demo", path="out/demo.mp4", num_images=150, duration_s=6.0),
    Event(session="demo", number=4, sequence=4, name="recorded", detail="out/demo.mp4"),
    AudioChunk(**COMMON, token="t", pcm=b"\x00\x01\xff\x7f"),  # type: ignore[arg-type]
    EndOfAudio(**COMMON, token="t"),  # type: ignore[arg-type]
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
    Lips(**COMMON, values=MOUTH, delay=960, closure=0.75, lip_to_teeth=0.125),  # type: ignore[arg-type]
    Progress(**COMMON, level_db=-20.5),  # type: ignore[arg-type]
    EndOfPhones(**COMMON),  # type: ignore[arg-type]
    Acknowledge(**COMMON),  # type: ignore[arg-type]
    FapFrame(**COMMON, values=FAPS, mask=bytes([252] + [255] * 7 + [15])),  # type: ignore[arg-type]
    EndOfFaps(**COMMON),  # type: ignore[arg-type]
    Joined(session="demo", publisher="p1"),
    Express(session="demo", request="r5", expressions={"joy": 0.5, "squint": 1.0}, hold_s=2.5),
    ChooseExpressiveness(session="demo", request="r6", expressiveness=1.25),
    AllowedKeys(
        keys={
            "D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs": AllowedKey(name="laptop", roles=["client"])
        }
    ),
    Stalled(**COMMON),  # type: ignore[arg-type]
    ResumeFace(**COMMON, frame=50, faps=FAPS),  # type: ignore[arg-type]
    Shapes(**COMMON, set="vrm", weights=np.arange(12, dtype="<f4").tobytes()),  # type: ignore[arg-type]
    AddShapes(session="demo", request="r7", shapes=["arkit", "vrm"]),
)
