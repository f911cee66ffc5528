"""One WebRTC connection: an audio track in, data channels out. Needs aiortc (extra ``webrtc``)."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable, Sequence

import aioice
import numpy as np
from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCDataChannel,
    RTCPeerConnection,
    RTCSessionDescription,
)
from aiortc.mediastreams import MediaStreamError
from av import AudioFrame

from kouxing.shared.errors import UserError

CONNECT_LIMIT_S = 20.0  # from the answer to the first sound
CONCEALED = 14_400  # samples at most: what was lost is replaced, so that speech goes on
MAX_GAP = 600 * 48_000  # samples; a longer one is a new beginning
_TIMESTAMPS = 2**32  # then RTP's timestamps begin anew
_OPUS = re.compile(r"^a=rtpmap:\d+ opus/48000/2\s*$", re.IGNORECASE | re.MULTILINE)


def use_addresses(addresses: Sequence[str]) -> None:
    """Let all connections of this process use these addresses of the machine, and no others."""
    aioice.ice.get_host_addresses = lambda use_ipv4, use_ipv6: [*addresses]


class Peer:
    """One connection, as the side that answers.

    Parameters
    ----------
    on_channel
        Called with every data channel that the other side opens.
    """

    rate_hz, num_channels = 48_000, 2  # what Opus is decoded to, as s16le

    def __init__(self, on_channel: Callable[[RTCDataChannel], None]) -> None:
        # No server elsewhere is asked how this machine is reached.
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._connection.on("datachannel", on_channel)
        self._connection.on("track", self._on_track)
        self._track: MediaStreamTrack | None = None

    async def answer(self, offer: str) -> str:
        """Return the answer to the other side's offer; it names all addresses.

        Raises
        ------
        UserError
            If it is no offer, or offers no audio in Opus.
        """
        try:
            await self._connection.setRemoteDescription(RTCSessionDescription(offer, "offer"))
            for transceiver in self._connection.getTransceivers():
                is_sound = transceiver.receiver.track is self._track
                transceiver.direction = "recvonly" if is_sound else "inactive"
            await self._connection.setLocalDescription(await self._connection.createAnswer())
        except Exception as error:  # of any kind, where a line is not as aiortc expects it
            raise UserError(f"expected an SDP offer that can be answered: {error}") from None
        if self._track is None or not _OPUS.search(offer):
            raise UserError("expected an offer with an audio track in Opus (opus/48000/2)")
        return self._connection.localDescription.sdp

    async def sound(self) -> AsyncIterator[tuple[int, bytes, int]]:
        """Yield what comes until the connection ends.

        Up to ``CONCEALED`` samples that were lost are replaced by what came before, ever softer.

        Yields
        ------
            How many samples of each channel are missing before it, PCM, and its number of samples.
        """
        expected: int | None = None
        pcm = b""
        while self._track is not None:
            limit_s = CONNECT_LIMIT_S if expected is None else None
            try:
                frame = await asyncio.wait_for(self._track.recv(), limit_s)
            except (MediaStreamError, TimeoutError):
                return
            if not isinstance(frame, AudioFrame) or frame.pts is None:
                continue
            lost = 0 if expected is None else (frame.pts - expected) % _TIMESTAMPS
            if lost > _TIMESTAMPS // 2:  # it comes too late
                continue
            expected = frame.pts + frame.samples
            if 0 < lost <= CONCEALED:
                yield 0, self._fading(pcm, lost), lost
                lost = 0
            pcm = bytes(frame.planes[0])[: frame.samples * self.num_channels * 2]
            yield lost if lost <= MAX_GAP else 0, pcm, frame.samples

    def _fading(self, pcm: bytes, num_samples: int) -> bytes:
        """Return PCM again and again, each time half as loud."""
        samples = np.frombuffer(pcm, "<i2").reshape(-1, self.num_channels)
        num_times = -(-num_samples // len(samples))
        faded = np.concatenate([samples * 0.5**time for time in range(1, num_times + 1)])
        return faded[:num_samples].astype("<i2").tobytes()

    async def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(Exception):  # of one that was never whole
            await self._connection.close()

    def _on_track(self, track: MediaStreamTrack) -> None:
        if track.kind == "audio" and self._track is None:
            self._track = track
