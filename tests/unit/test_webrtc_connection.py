"""The received audio of a WebRTC connection, from the timestamps of its packets."""

from typing import Any, cast

import numpy as np
import pytest
from aiortc.mediastreams import MediaStreamError
from av import AudioFrame

from kouxing.services.gateway.webrtc.connection import MAX_CONCEALED_SAMPLES, WebRtcPeer
from tests.fake_time import with_fake_time

PACKET = 960  # samples
START = 10**9


class FakeTrack:
    """A track whose packets have these timestamps; then the connection ends."""

    def __init__(self, timestamps: list[int]) -> None:
        self._timestamps = iter(timestamps)

    async def recv(self) -> AudioFrame:
        for timestamp in self._timestamps:
            samples = np.full((1, 2 * PACKET), 1000, np.int16)
            frame = AudioFrame.from_ndarray(samples, format="s16", layout="stereo")
            frame.pts = timestamp
            return frame
        raise MediaStreamError


@pytest.mark.parametrize(
    ("third", "expected"),
    [
        (START + 2 * PACKET, [(0, PACKET)]),
        (START + 3 * PACKET, [(0, PACKET), (0, PACKET)]),  # a packet is concealed
        (START + 2 * PACKET + MAX_CONCEALED_SAMPLES + 1, [(MAX_CONCEALED_SAMPLES + 1, PACKET)]),
        (START, []),  # late
        (START + 2**30, [(0, PACKET)]),  # a new stream
        (0, [(0, PACKET)]),
    ],
)
@with_fake_time
async def test_timestamps_show_lost_and_late_packets_and_new_streams(
    third: int, expected: list[tuple[int, int]]
) -> None:
    peer = WebRtcPeer(lambda _: None)
    peer._track = cast("Any", FakeTrack([START, START + PACKET, third]))
    received = [(lost, samples) async for lost, _, samples in peer.receive_audio()]
    assert received == [(0, PACKET), (0, PACKET), *expected]
    await peer.close()
