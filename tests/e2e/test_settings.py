"""Settings that change what a running system does, and its end."""

import asyncio
import signal
from collections.abc import Iterator

import aiohttp
import aioice
import numpy as np
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection
from kouxing_client import Client, KouxingError, Refused
from numpy.typing import NDArray

from kouxing.evaluation.system.live import ReceivedResults, speak
from kouxing.services.control.worker_load import MIN_SESSIONS, RETRY_AFTER_S
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.service_kinds import KINDS
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.settings.config import variable_name
from tests.e2e.streaming import StreamedSession, stream_audio
from tests.system import BLOCK_NETWORK, LIMIT_S, VOWELS_FILE, System, samples_of_file, wait_until

FACE = SynthesizerConfig(
    lips="dynamic-visemes", delay_ms=160.0, frame_rate_hz=30.0, idle_motion=False
)
SETTINGS = {
    **BLOCK_NETWORK,
    **{
        variable_name("synthesizer", key): str(getattr(FACE, key))
        for key in ("lips", "delay_ms", "frame_rate_hz", "idle_motion")
    },
    "KOUXING_CONTROL_MAX_LOAD": "0.1",  # less than one session needs
}
SAMPLES = samples_of_file(VOWELS_FILE)


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with System(KINDS, tmp_path_factory.mktemp("settings"), SETTINGS) as running:
        yield running


def frames_of_the_pipeline(lips: str) -> NDArray[np.float32]:
    pipeline = LivePipeline(load_model(), load_lip_model(name=lips), synthesizer=FACE)
    frames = pipeline.accept_waveform(SAMPLES) + pipeline.input_finished()
    return np.array([faps for _, faps in frames])


def test_the_face_has_the_frames_of_the_chain_with_these_settings(system: System) -> None:
    streamed = stream_audio(system.control, SAMPLES, chunk=997)
    np.testing.assert_allclose(np.diff(np.array(streamed.times) / 16000), 1 / 30, atol=1e-4)
    np.testing.assert_array_equal(streamed.faps, frames_of_the_pipeline("dynamic-visemes"))
    assert np.abs(streamed.faps[:, 2]).max() > 50.0


def test_lips_are_switched_while_a_session_runs(client: Client) -> None:
    with client.open_session(encoding="f32le", paced=False) as session:
        with pytest.raises(Refused, match="unknown lip model 'muscles'; use "):
            client.open_session(face={"lip_model": "muscles"})
        with pytest.raises(Refused, match="unknown lip model 'muscles'; use "):
            session.set_face(lip_model="muscles")
        session.set_face(lip_model="learned")
        streamed = StreamedSession(session)
        streamed.send(SAMPLES)
        streamed.finish()
    # the choice may overtake the start of the audio; the face is at rest there
    np.testing.assert_allclose(streamed.faps, frames_of_the_pipeline("learned"), atol=0.5)


def test_rejects_one_session_too_many_and_the_others_continue(
    system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr("kouxing.evaluation.system.live.END_TIMEOUT_S", 60.0)
    samples = SAMPLES[:24000]
    with Client(system.control) as client:
        alone = stream_audio(system.control, samples)
        sessions = [client.open_session(encoding="f32le") for _ in range(MIN_SESSIONS)]
        with pytest.raises(Refused, match="every recognizer is busy") as caught:
            client.open_session(encoding="f32le")
        all_received = speak(sessions, samples)
        message, answer = asyncio.run(_rejections(system.page))
        for session in sessions:
            session.close()

    assert (caught.value.code, caught.value.retry_after_s) == ("busy", RETRY_AFTER_S)
    assert (message["code"], message["retry_after_s"]) == ("busy", RETRY_AFTER_S)
    assert (answer.status, answer.headers["Retry-After"]) == (503, f"{RETRY_AFTER_S:.0f}")
    expected = ReceivedResults(phones=alone.phones).spoken_phones()
    for received in all_received:
        assert (received.ended, received.error) == (True, "")
        assert {*alone.times} <= {frame.media_time for _, frame in received.frames}
        phones = received.spoken_phones()
        assert [phone.symbol for phone in phones] == [phone.symbol for phone in expected]


async def _rejections(page: str) -> tuple[dict[str, object], aiohttp.ClientResponse]:
    """Return the gateway's answers to a microphone and to a WebRTC client."""
    peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    peer.addTransceiver("audio")
    await peer.setLocalDescription(await peer.createOffer())
    sdp, headers = peer.localDescription.sdp, {"Content-Type": "application/sdp"}
    async with aiohttp.ClientSession() as http:
        async with http.ws_connect(f"{page}microphone") as microphone:
            await microphone.send_str('{"sample_rate_hz": 16000}')
            message = await microphone.receive_json(timeout=60)
        async with http.post(f"{page}whip", data=sdp, headers=headers) as answer:
            await answer.read()
    await peer.close()
    return message, answer


def test_control_closes_a_session_without_audio(system: System) -> None:
    assert system.lose("control", signal.SIGTERM).wait(LIMIT_S) == 0
    system.start("control", KOUXING_CONTROL_IDLE_LIMIT_S="5")
    system.wait_until(lambda report: {*KINDS} <= {state.service for state in report.services})
    with Client(system.control) as client:
        idle = client.open_session(encoding="f32le")
        event = next(event for event in idle.events() if event.name == "session-closed")
        assert "no audio" in event.detail
        with pytest.raises(KouxingError, match=r"control has closed the session: .*no audio"):
            list(idle.frames())


def test_every_service_stops_cleanly_on_sigterm(system: System) -> None:
    processes = [system.lose(name, signal.SIGTERM) for name in KINDS]
    assert [process.wait(LIMIT_S) for process in processes] == [0] * len(processes)
    wait_until(lambda: all('"message": "stopped"' in system.log(name) for name in KINDS))
    assert not any("traceback" in system.log(name).lower() for name in KINDS)
