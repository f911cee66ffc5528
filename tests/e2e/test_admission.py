"""More sessions than the services can serve: one too many is refused, the others notice nothing."""

from __future__ import annotations

import asyncio
from pathlib import Path

import aiohttp
import aioice
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection
from kouxing_client import Client, Refused

from kouxing.evaluation.system.live import speak
from kouxing.services.control.load import MIN_SESSIONS, RETRY_AFTER_S
from tests.e2e.following import samples_of_file, stream
from tests.scripted_system import Gateway
from tests.system import VOWELS_FILE, System, free_port

pytestmark = pytest.mark.e2e
SERVICES = ("control", "recognizer", "synthesizer")
SETTINGS = {"KOUXING_CONTROL_MAX_LOAD": "0.1"}  # less than a session takes


def test_one_session_too_many_is_refused_and_the_others_go_on_unharmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    samples = samples_of_file(VOWELS_FILE)[:48000]
    with System(SERVICES, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        gateway = Gateway(system.control, free_port())
        system.processes["gateway"] = gateway.process
        system.wait_ready()
        alone = stream(system.control, samples)
        sessions = [client.open_session(encoding="f32le") for _ in range(MIN_SESSIONS)]
        with pytest.raises(Refused, match="every recognizer is busy") as caught:
            client.open_session(encoding="f32le")
        all_seen = speak(sessions, samples)
        told, answer = asyncio.run(_refused(gateway.page))
        with pytest.raises(Refused, match="busy"):
            client.open_session(encoding="f32le")
        for session in sessions:
            session.close()

    assert (caught.value.code, caught.value.retry_after_s) == ("busy", RETRY_AFTER_S)
    assert (told["code"], told["retry_after_s"]) == ("busy", RETRY_AFTER_S)
    assert (answer.status, answer.headers["Retry-After"]) == (503, f"{RETRY_AFTER_S:.0f}")
    times = {frame.media_time for frame in alone.frames}
    for seen in all_seen:
        assert (seen.ended, seen.error) == (True, "")
        assert times <= {frame.media_time for _, frame in seen.frames}
        phones = {phone.index: phone.symbol for phone in seen.phones}
        assert [phones[index] for index in sorted(phones)] == alone.symbols


async def _refused(page: str) -> tuple[dict[str, object], aiohttp.ClientResponse]:
    """Return what the gateway tells a microphone and a WebRTC client."""
    peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
    peer.addTransceiver("audio")
    await peer.setLocalDescription(await peer.createOffer())
    sdp, headers = peer.localDescription.sdp, {"Content-Type": "application/sdp"}
    async with aiohttp.ClientSession() as http:
        async with http.ws_connect(f"{page}microphone") as microphone:
            await microphone.send_str('{"sample_rate_hz": 16000}')
            told = await microphone.receive_json(timeout=60)
        async with http.post(f"{page}whip", data=sdp, headers=headers) as answer:
            await answer.read()
    await peer.close()
    return told, answer
