"""The recognizer's loop with real sockets: how much it does at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import pytest

from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.service import MAX_BATCH_S, MAX_UNPACED_S, RecognizerService
from kouxing.services.recognizer.synthesizer_link import SynthesizerLink
from kouxing.shared.bus import Bus
from kouxing.shared.keys import Peer
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message
from kouxing.shared.wire.speech import AudioState, Progress
from tests.live_streams import START
from tests.system import free_port

pytestmark = pytest.mark.e2e
RATE_HZ = START.sample_rate_hz
PHONE_INPUT = {"phone_input": f"tcp://127.0.0.1:{free_port()}"}
UNPACED = replace(START, paced=False, endpoints=PHONE_INPUT)


class Recognizer(RecognizerService):
    """Records warnings, and the sessions' media times whenever a heartbeat may be sent."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        nobody = f"tcp://127.0.0.1:{free_port()}"
        super().__init__(
            RecognizerConfig(
                control=nobody, audio=local, phones=local, unpaced_audio=local, insecure=True
            )
        )
        self.media_times: list[int] = [0]
        self.warned: list[tuple[str, str]] = []

    def warn(self, reason: str, text: str, session: str = "") -> None:
        self.warned.append((reason, text))

    def send_heartbeat_if_due(self) -> None:
        self.media_times += [session.stream.media_time for session in self._sessions.values()]

    def receive(self, message: AudioChunk) -> None:
        """Handle a client's message."""
        self._on_audio(self._sessions[message.session].socket, message, Peer())

    def decode_all(self) -> None:
        while self._unpaced:
            self._decode_unpaced()
            self.send_heartbeat_if_due()


@pytest.fixture
def service() -> Iterator[Recognizer]:
    running = Recognizer()
    yield running
    running.bus.close()


def chunk(number: int, num_bytes: int, session: str = "s") -> AudioChunk:
    """Return the ``number``-th chunk of this size, from 0."""
    return AudioChunk(
        session=session,
        token="t",
        sequence=number + 1,
        media_time=number * num_bytes,
        pcm=bytes(num_bytes),
    )


@pytest.mark.parametrize("paced", [False, True])
def test_decodes_a_long_chunk_in_parts_with_heartbeats_between(
    service: Recognizer, paced: bool
) -> None:
    service.start_session(replace(UNPACED, paced=paced))
    service.receive(chunk(0, MAX_AUDIO_BYTES))
    service.decode_all()
    steps = [after - before for before, after in pairwise(service.media_times)]
    assert max(steps) <= MAX_BATCH_S * 16000 + 320
    # 2 bytes per sample at half the rate
    assert service.media_times[-1] == pytest.approx(MAX_AUDIO_BYTES, abs=MAX_BATCH_S * 16000)


def test_decodes_live_audio_before_unpaced_audio(service: Recognizer) -> None:
    service.start_session(UNPACED)
    service.start_session(replace(UNPACED, session="live", paced=True))
    live, other = (service._sessions[name].stream for name in ("live", "s"))
    num_long, num_short = 12, 100
    with Bus() as bus:
        unpaced = bus.connect_dealer(service.endpoints["unpaced_audio"])
        for number in range(num_long):  # of 0.5 s
            unpaced.send(chunk(number, RATE_HZ))
        paced = bus.connect_dealer(service.endpoints["audio"])
        for number in range(num_short):  # of 20 ms
            paced.send(chunk(number, 320, "live"))
            assert service._audio.wait(30.0)
            before = other.media_time
            service.step(0.0)
            assert live.next_media_time == 320 * (number + 1)  # at once
            assert other.media_time - before <= MAX_UNPACED_S * 16000 + 320
        end_s = time.monotonic() + 60
        while other.next_media_time < 8000 * num_long and time.monotonic() < end_s:
            service.step(0.01)
        assert other.next_media_time == 8000 * num_long
        assert other.num_gaps == 0  # no audio was dropped
    assert not service.warned


def test_unpaced_audio_waits_at_its_sender_while_live_audio_continues(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.start_session(UNPACED)
    session = service._sessions["s"]
    monkeypatch.setattr(service._audio, "wait", lambda _timeout_s: True)
    num_sent = 0
    with Bus() as bus:
        unpaced = bus.connect_dealer(service.endpoints["unpaced_audio"], queue_length=10)
        for _ in range(500):
            num_sent += unpaced.send(chunk(num_sent, MAX_AUDIO_BYTES))
            service.step(0.001)
    assert num_sent < 250, "the socket must be full"
    assert (session.order.last, session.stream.media_time) == (1, 0)


def test_acknowledges_the_end_once_everything_before_it_is_decoded(service: Recognizer) -> None:
    service.start_session(UNPACED)
    session = service._sessions["s"]
    service.receive(chunk(0, 2 * RATE_HZ))
    service.receive(AudioChunk(session="s", token="t", sequence=2, last=True, acknowledge=True))
    assert (session.received_sequence, session.is_finished) == (1, False)
    service.decode_all()
    assert (session.received_sequence, session.is_finished) == (2, True)


def test_rejects_live_audio_far_ahead_of_the_clock(service: Recognizer) -> None:
    service.start_session(replace(UNPACED, paced=True))
    for number in range(10):  # of 4 s
        service.receive(chunk(number, 8 * RATE_HZ))
    assert {reason for reason, _ in service.warned} == {"bad-audio"}
    assert "paced = false" in service.warned[0][1]


def test_reports_a_bad_mouth_profile_once_and_continues(service: Recognizer) -> None:
    service.start_session(replace(UNPACED, mouth_profile=b"not a profile"))
    for number in range(2):
        service.receive(chunk(number, 3200))
    service.decode_all()
    assert [reason for reason, _ in service.warned] == ["bad-mouth-profile"]
    assert service.media_times[-1] == pytest.approx(6400, abs=640)


def test_reports_a_stalled_client_again_after_a_flush_and_to_a_new_face(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Message] = []
    monkeypatch.setattr(
        SynthesizerLink, "send", lambda _link, message, _now_s: sent.append(message)
    )
    now_s = time.monotonic()

    def num_reports(num_ticks: int) -> int:
        nonlocal now_s
        sent.clear()
        for _ in range(num_ticks):
            now_s += 0.01
            service.on_tick(now_s)
        progress = [message for message in sent if isinstance(message, Progress)]
        return sum(message.state == AudioState.STALLED for message in progress)

    start = replace(UNPACED, paced=True)
    service.start_session(start)
    assert [num_reports(100), num_reports(100)] == [1, 0]
    service.flush_session("s")
    assert num_reports(100) == 1
    service.start_session(replace(start, epoch=2))
    assert num_reports(100) == 1
