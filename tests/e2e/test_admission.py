"""More sessions than the services can serve: one is refused, and the others are not disturbed."""

from __future__ import annotations

import asyncio
from pathlib import Path

import aiohttp
import aioice
import pytest
from aiortc import RTCConfiguration, RTCPeerConnection
from kouxing_client import Client, Refused

from kouxing.evaluation.system.live import Seen, speak
from kouxing.services.control.load import MIN_SESSIONS, RETRY_AFTER_S
from tests.e2e.following import samples_of_file, stream
from tests.system import CHAIN, VOWELS_FILE, System

SETTINGS = {"KOUXING_CONTROL_MAX_LOAD": "0.1"}  # less than one session needs


def test_refuses_one_session_too_many_and_the_others_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aioice.ice, "get_host_addresses", lambda **_: ["127.0.0.1"])
    monkeypatch.setattr("kouxing.evaluation.system.live.END_LIMIT_S", 60.0)
    samples = samples_of_file(VOWELS_FILE)[:24000]
    services = (*CHAIN, "gateway")
    with System(services, tmp_path, SETTINGS) as system, Client(system.control) as client:
        alone = stream(system.control, samples)
        sessions = [client.open_session(encoding="f32le") for _ in range(MIN_SESSIONS)]
        with pytest.raises(Refused, match="every recognizer is busy") as caught:
            client.open_session(encoding="f32le")
        all_seen = speak(sessions, samples)
        message, answer = asyncio.run(_refused(system.page))
        for session in sessions:
            session.close()

    assert (caught.value.code, caught.value.retry_after_s) == ("busy", RETRY_AFTER_S)
    assert (message["code"], message["retry_after_s"]) == ("busy", RETRY_AFTER_S)
    assert (answer.status, answer.headers["Retry-After"]) == (503, f"{RETRY_AFTER_S:.0f}")
    expected = Seen(phones=alone.phones, speech=alone.speech).spoken_phones()
    for seen in all_seen:
        assert (seen.ended, seen.error) == (True, "")
        assert {*alone.times} <= {frame.media_time for _, frame in seen.frames}
        phones = seen.spoken_phones()
        assert [phone.symbol for phone in phones] == [phone.symbol for phone in expected]


async def _refused(page: str) -> tuple[dict[str, object], aiohttp.ClientResponse]:
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
