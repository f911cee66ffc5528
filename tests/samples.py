"""One message of every kind, as the golden bytes hold them."""

from __future__ import annotations

import numpy as np

from shared import messages as m

COMMON = {"session": "demo", "epoch": 1, "sequence": 7, "media_time": 16000}
FAPS = np.arange(68, dtype="<f4").tobytes()

SAMPLES: tuple[m.Message, ...] = (
    m.OpenSession(session="demo", request="r1", sample_rate_hz=48000, num_channels=2, record=True),
    m.SessionOpened(
        session="demo",
        request="r1",
        token="t",
        audio="tcp://127.0.0.1:5560",
        phones="tcp://127.0.0.1:5561",
        faps="tcp://127.0.0.1:5571",
        events="tcp://127.0.0.1:5551",
    ),
    m.CloseSession(session="demo", request="r2", token="t"),
    m.FlushSession(session="demo", request="r3", token="t"),
    m.StatusRequest(request="r4"),
    m.StatusReport(
        request="r4",
        services=[
            m.ServiceState(
                service="recognizer",
                instance="recognizer-1",
                state="ready",
                age_s=0.25,
                clock_offset_ms=-1.5,
                endpoints={"audio": "tcp://127.0.0.1:5560"},
                metrics={"chunk_ms_p50": 1.25},
            )
        ],
        sessions=[
            m.SessionState(
                session="demo",
                state="open",
                age_s=2.0,
                speaking=True,
                recognizer="recognizer-1",
                synthesizer="synthesizer-1",
            )
        ],
    ),
    m.Done(session="demo", request="r2"),
    m.Error(session="demo", code="unknown-session", text="there is no session", request="r2"),
    m.Heartbeat(
        service="recognizer",
        instance="recognizer-1",
        state="ready",
        sent_ns=1_700_000_000_000_000_000,
        endpoints={"audio": "tcp://127.0.0.1:5560"},
        metrics={"in_audio": 3.0},
        idle_s={"demo": 0.5},
    ),
    m.HeartbeatSeen(sent_ns=1, received_ns=2, replied_ns=3),
    m.StartSession(
        session="demo",
        epoch=1,
        request="start-demo-1",
        token="t",
        encoding="s16le",
        sample_rate_hz=16000,
        num_channels=1,
        record=False,
        paced=True,
        phone_input="tcp://127.0.0.1:5570",
        phones="tcp://127.0.0.1:5561",
        faps="tcp://127.0.0.1:5571",
    ),
    m.StopSession(session="demo", epoch=1),
    m.FlushNow(session="demo", epoch=1),
    m.Recorded(session="demo", path="out/demo.mp4", num_images=150, duration_s=6.0),
    m.Event(session="demo", number=4, sequence=4, name="recorded", detail="out/demo.mp4"),
    m.AudioChunk(**COMMON, token="t", pcm=b"\x00\x01\xff\x7f"),  # type: ignore[arg-type]
    m.EndOfAudio(**COMMON, token="t"),  # type: ignore[arg-type]
    m.Sound(**COMMON, pcm=b"\x00\x01\xff\x7f"),  # type: ignore[arg-type]
    m.Speech(**COMMON, active=True),  # type: ignore[arg-type]
    m.PhoneHeard(
        **COMMON,  # type: ignore[arg-type]
        index=3,
        unit="iang",
        duration=1600,
        confidence=0.5,
        final=False,
    ),
    m.Progress(**COMMON, level_db=-20.5),  # type: ignore[arg-type]
    m.EndOfPhones(**COMMON),  # type: ignore[arg-type]
    m.Acknowledge(**COMMON),  # type: ignore[arg-type]
    m.FapFrame(**COMMON, values=FAPS, mask=bytes([252] + [255] * 7 + [15])),  # type: ignore[arg-type]
    m.EndOfFaps(**COMMON),  # type: ignore[arg-type]
    m.Joined(session="demo", publisher="p1"),
)
