"""The recognizer's loop in one process: how much it does at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lip_predictor import (
    NUM_OUTPUTS,
    LipPredictor,
    lip_predictor_for,
    load_lip_predictor,
)
from kouxing.services.recognizer.mouth_profile import MouthProfile
from kouxing.services.recognizer.service import (
    MAX_LEAD_S,
    MAX_QUEUED_S,
    MAX_UNPACED_S,
    RecognizerService,
)
from kouxing.shared.bus import Bus
from kouxing.shared.keys import Peer
from kouxing.shared.phones.events import LipFrame
from kouxing.shared.reliable import ReliableSender
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message
from kouxing.shared.wire.session import SessionFacts
from kouxing.shared.wire.speech import AudioState, Progress
from tests.e2e.following import samples_of_file
from tests.live_streams import LiveStream
from tests.system import VOWELS_FILE, free_port

pytestmark = pytest.mark.unit
RATE_HZ = 8000


class Watched(RecognizerService):
    """Notes the media time of the session whenever a heartbeat may leave."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        nobody = f"tcp://127.0.0.1:{free_port()}"
        config = RecognizerConfig(
            control=nobody, audio=local, phones=local, unpaced_audio=local, insecure=True
        )
        super().__init__(config)
        self.media_times: list[int] = [0]
        self.warnings_given: list[tuple[str, str]] = []

    def warn(self, reason: str, text: str, session: str = "") -> None:
        self.warnings_given.append((reason, text))

    def take(self, message: AudioChunk) -> None:
        """Take a message of a client."""
        socket = self._sessions[message.session].socket
        self._on_audio(socket, message, Peer())

    def work_off(self) -> None:
        """Process what has come."""
        self._process_queued()
        while self._unpaced:
            self._process_unpaced()
            self.send_heartbeat_if_due()

    def send_heartbeat_if_due(self) -> None:
        self.media_times += [session.stream.media_time for session in self._sessions.values()]


@pytest.fixture
def service() -> Iterator[Watched]:
    made = Watched()
    yield made
    made.bus.close()


def start_of(mouth_profile: bytes | None = None) -> StartSession:
    return StartSession(
        session="s",
        epoch=1,
        request="r",
        token="t",
        encoding="s16le",
        sample_rate_hz=RATE_HZ,
        num_channels=1,
        record=False,
        paced=False,
        facts=SessionFacts(language="mandarin", delay_ms=0.0),
        endpoints={"phone_input": f"tcp://127.0.0.1:{free_port()}"},
        mouth_profile=mouth_profile,
    )


def steps_of(times: list[int]) -> list[int]:
    return [after - before for before, after in pairwise(times)]


def test_the_longest_chunk_is_processed_in_pieces_with_heartbeats_between(service: Watched) -> None:
    service.start_session(start_of())
    service.take(AudioChunk(session="s", token="t", sequence=1, pcm=bytes(MAX_AUDIO_BYTES)))
    service.work_off()
    assert max(steps_of(service.media_times)) <= MAX_QUEUED_S * 16000 + 320
    assert service.media_times[-1] == pytest.approx(
        MAX_AUDIO_BYTES, abs=320
    )  # 2 bytes at half the rate


def test_live_audio_is_processed_before_what_is_not_paced(service: Watched) -> None:
    service.start_session(start_of())
    service.start_session(replace(start_of(), session="live", paced=True))
    live, other = (service._sessions[name].stream for name in ("live", "s"))
    num_long, num_short = 12, 100
    with Bus() as bus:
        pouring = bus.connect_dealer(service.endpoints["unpaced_audio"])
        for number in range(num_long):  # of 0.5 s
            pcm, media_time = bytes(RATE_HZ), 8000 * number
            pouring.send(
                AudioChunk(
                    session="s", token="t", sequence=number + 1, media_time=media_time, pcm=pcm
                )
            )
        speaking = bus.connect_dealer(service.endpoints["audio"])
        for number in range(num_short):  # of 20 ms
            media_time = 320 * number
            speaking.send(
                AudioChunk(
                    session="live",
                    token="t",
                    sequence=number + 1,
                    media_time=media_time,
                    pcm=bytes(320),
                )
            )
            assert service._audio.wait(5.0)
            before = other.media_time
            service.step(0.0)
            assert live.next_media_time == media_time + 320  # at once
            assert other.media_time - before <= MAX_UNPACED_S * 16000 + 320
        assert other.media_time > 0.5 * MAX_UNPACED_S * 16000 * num_short  # as time is left
        end_s = time.monotonic() + 60
        while other.next_media_time < 8000 * num_long and time.monotonic() < end_s:
            service.step(0.01)
        assert other.next_media_time == 8000 * num_long
        assert other.num_gaps == 0  # nothing was dropped
    assert not service.warnings_given


def test_what_is_not_paced_waits_at_its_sender_while_live_audio_does_not_end(
    service: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.start_session(start_of())
    other = service._sessions["s"]
    monkeypatch.setattr(service._audio, "wait", lambda _timeout_s: True)
    pcm, num_taken = bytes(MAX_AUDIO_BYTES), 0
    with Bus() as bus:
        pouring = bus.connect_dealer(service.endpoints["unpaced_audio"], queue_length=10)
        for _ in range(500):
            sequence = num_taken + 1
            num_taken += pouring.send(
                AudioChunk(session="s", token="t", sequence=sequence, pcm=pcm)
            )
            service.step(0.001)
    assert num_taken < 250, "its socket takes no more"
    assert (other.order.last, other.stream.media_time) == (1, 0)


def test_the_end_is_acknowledged_when_all_before_it_is_processed(service: Watched) -> None:
    service.start_session(start_of())
    session = service._sessions["s"]
    service.take(AudioChunk(session="s", token="t", sequence=1, pcm=bytes(2 * RATE_HZ)))
    service.take(AudioChunk(session="s", token="t", sequence=2, last=True, acknowledge=True))
    assert (session.num_taken, session.finished) == (1, False)
    service.work_off()
    assert (session.num_taken, session.finished) == (2, True)


def test_audio_at_the_other_socket_is_refused(service: Watched) -> None:
    service.start_session(start_of())
    chunk = AudioChunk(session="s", token="t", sequence=1, pcm=bytes(320))
    service._on_audio(service._audio, chunk, Peer())
    assert service.warnings_given == [
        ("bad-audio", "send the audio of session 's' where session-opened says")
    ]


def test_live_audio_far_ahead_of_the_clock_is_refused(service: Watched) -> None:
    service.start_session(replace(start_of(), paced=True))
    for number in range(1, 11):  # of 4 s
        pcm = bytes(8 * RATE_HZ)
        service.take(AudioChunk(session="s", token="t", sequence=number, pcm=pcm))
    assert {reason for reason, _ in service.warnings_given} == {"bad-audio"}
    assert "paced false" in service.warnings_given[0][1]


def test_live_audio_that_waited_for_another_recognizer_is_taken(service: Watched) -> None:
    service.start_session(replace(start_of(), paced=True, epoch=2))
    for number in range(1, 6):  # of 4 s
        pcm = bytes(8 * RATE_HZ)
        service.take(AudioChunk(session="s", token="t", epoch=2, sequence=number, pcm=pcm))
    assert service.warnings_given == []


def test_the_clock_counts_from_where_live_audio_last_waited(service: Watched) -> None:
    service.start_session(replace(start_of(), paced=True))
    session = service._sessions["s"]
    now_s, end_s = session._lead_at_s, 0.0

    def take(duration_s: float, gap_s: float = 0.0) -> bool:
        """Whether so much sound is taken, after a gap."""
        nonlocal end_s
        if session.is_ahead(end_s + gap_s, duration_s, now_s):
            return False
        end_s += gap_s + duration_s
        return True

    assert all(take(1.0) for _ in range(int(MAX_LEAD_S)))
    assert not take(1.0)
    now_s += 2.0
    assert take(1.0)
    assert take(1.0)
    assert not take(1.0)
    now_s += 600.0  # stopped, or cut off, for long
    assert all(take(1.0) for _ in range(int(2 * MAX_LEAD_S)))
    assert not take(1.0)
    for _ in range(24 * 3600):  # its clock is faster by 1 in 1000
        now_s += 1.0
        assert take(1.001)
    now_s += 600.0
    assert take(1.0, gap_s=600.0)  # no frames are made of it
    assert take(1.0, gap_s=9.9)
    assert take(1.0, gap_s=9.9)
    assert not take(1.0, gap_s=9.9)
    assert take(1.0, gap_s=5.0)


def test_a_session_taken_over_keeps_to_its_media_time(service: Watched) -> None:
    service.start_session(replace(start_of(), epoch=2, media_time=24_000))
    for number in range(100):  # of 20 ms; the first three lie before the grid
        chunk = AudioChunk(
            session="s",
            token="t",
            sequence=9 + number,
            media_time=9280 + 320 * number,
            pcm=bytes(320),
        )
        service.take(chunk)
    service.work_off()
    assert service._sessions["s"].stream.next_media_time == 9280 + 100 * 320


@pytest.mark.parametrize(
    "profile",
    [
        b"not a profile",
        MouthProfile(
            scale=np.ones(15, np.float32),
            offset=np.zeros(15, np.float32),
            residual=np.zeros((2, 2, 15), np.float32),
        ).to_bytes(bytes(32)),
    ],
)
def test_a_mouth_profile_that_does_not_fit_is_refused_once_and_the_session_goes_on(
    service: Watched, profile: bytes
) -> None:
    service.start_session(start_of(profile))
    for sequence in (1, 2):
        service.take(AudioChunk(session="s", token="t", sequence=sequence, pcm=bytes(3200)))
    service.work_off()
    assert [reason for reason, _ in service.warnings_given] == ["bad-mouth-profile"]
    assert "the mouth profile is not used" in service.warnings_given[0][1]
    assert service.media_times[-1] == pytest.approx(6400, abs=640)


def test_a_session_has_the_lips_of_its_mouth_profile(service: Watched) -> None:
    lips = load_lip_predictor()
    profile = MouthProfile(
        scale=np.zeros(15, np.float32),
        offset=np.full(15, 77, np.float32),
        residual=np.zeros(lips.residual_shape, np.float32),
    )
    start = start_of(profile.to_bytes(lips.digest))
    service.start_session(start)
    stream = service._sessions["s"].stream
    stream.accept_waveform(samples_of_file(VOWELS_FILE)[:16_000])
    service._recognizer.decode_streams([stream])
    events = service._recognizer.get_result(stream)
    frames = [event for event in events if isinstance(event, LipFrame)]
    assert len(frames) > 5
    assert {frame.faps[0] for frame in frames} == {77.0}
    assert not service.warnings_given


def tiny_lips(num_features: int) -> LipPredictor:
    rng = np.random.default_rng(1)

    def weights(*shape: int) -> np.ndarray:
        return rng.normal(0.0, 0.1, shape).astype(np.float32)

    return LipPredictor(
        delays=np.array([0.0, 0.1], np.float32),
        feature_mean=weights(num_features),
        projection=weights(num_features, 3),
        entry_weights=weights(3, 4),
        entry_bias=weights(4),
        input_weights=weights(4, 12),
        input_bias=weights(12),
        state_weights=weights(4, 12),
        state_bias=weights(12),
        history_weights=weights(2, 3, 2, NUM_OUTPUTS),
        output_weights=weights(8, 2, NUM_OUTPUTS),
        output_bias=weights(2, NUM_OUTPUTS),
    )


def test_the_shipped_lips_are_used_with_the_network_that_they_were_trained_on(
    tmp_path: Path,
) -> None:
    path = tmp_path / "lips.npz"
    neural = load_model()
    width = 2 * 80 + 2 * 512
    tiny_lips(width + 2).save(path)
    assert lip_predictor_for(neural, path) is None
    tiny_lips(width).save(path)
    assert lip_predictor_for(load_model(model_path("gmm")), path) is None
    lips = lip_predictor_for(neural, path)
    assert lips is not None
    events = LiveStream(neural, lips=lips, face_delay_s=0.2).feed(samples_of_file(VOWELS_FILE))
    frames = [event for event in events if isinstance(event, LipFrame)]
    assert len(frames) > 50
    assert {frame.delay_s for frame in frames} == {0.1}


def test_a_face_is_told_of_a_silent_client_once_and_again_when_it_is_another_or_was_flushed(
    service: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Message] = []
    monkeypatch.setattr(
        ReliableSender, "send", lambda _sender, message, _now_s: told.append(message)
    )
    now_s = time.monotonic()

    def num_told(num_ticks: int) -> int:
        nonlocal now_s
        told.clear()
        for _ in range(num_ticks):
            now_s += 0.01
            service.on_tick(now_s)
        return sum(isinstance(m, Progress) and m.state == AudioState.STALLED for m in told)

    start = replace(start_of(), paced=True)
    service.start_session(start)
    assert num_told(100) == 1
    assert num_told(100) == 0
    service.flush_session("s")
    assert num_told(100) == 1
    service.start_session(replace(start, epoch=2))
    assert num_told(100) == 1
