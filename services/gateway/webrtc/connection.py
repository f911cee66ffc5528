"""One WebRTC connection with an audio track and data channels. Needs aiortc (extra ``webrtc``)."""

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable, Sequence

import aioice
import aiortc.rtcrtpreceiver
import numpy as np
from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCDataChannel,
    RTCPeerConnection,
    RTCRtpCodecCapability,
    RTCSessionDescription,
)
from aiortc.jitterbuffer import JitterBuffer, JitterFrame
from aiortc.mediastreams import MediaStreamError
from aiortc.rtp import RtpPacket
from av import AudioFrame

from kouxing.shared.errors import UserError

CONNECT_TIMEOUT_S = 20.0  # limit from the answer to the first sound
MAX_CONCEALED_SAMPLES = 14_400  # lost samples that are concealed, so that speech continues
MAX_GAP_SAMPLES = 600 * 48_000  # after a longer gap, forward or back, timestamps restart
_TIMESTAMP_RANGE = 2**32  # RTP timestamps wrap around at this value
_OPUS = RTCRtpCodecCapability("audio/opus", 48_000, 2)
_OPUS_LINE = re.compile(r"^a=rtpmap:\d+ opus/48000/2\s*$", re.IGNORECASE | re.MULTILINE)
_NOT_OPUS = "expected an offer that sends an audio track in Opus (opus/48000/2)"


def use_addresses(addresses: Sequence[str]) -> None:
    """Restrict all connections of this process to these addresses of the machine.

    aiortc and aioice have no option for this.
    """
    aioice.ice.get_host_addresses = lambda use_ipv4, use_ipv6: [*addresses]


class _NoJitterBuffer(JitterBuffer):
    """Passes each packet on when it arrives. An Opus packet is a whole frame.

    aiortc's buffer holds 80 ms of audio; after a lost packet, 0.32 s. If the client stops sending
    in pauses, it holds the end of the speech until the next packets arrive. It has no option for
    this.
    """

    def add(self, packet: RtpPacket) -> tuple[bool, JitterFrame | None]:
        return False, JitterFrame(packet._data, packet.timestamp)  # type: ignore[attr-defined]


def _make_jitter_buffer(
    capacity: int, prefetch: int = 0, *, is_video: bool = False
) -> JitterBuffer:
    kind = JitterBuffer if is_video else _NoJitterBuffer
    return kind(capacity, prefetch, is_video)


aiortc.rtcrtpreceiver.JitterBuffer = _make_jitter_buffer  # type: ignore[attr-defined,assignment]


class WebRtcPeer:
    """The answering side of one connection.

    ``on_channel`` is called with each data channel that the client opens.
    """

    rate_hz, num_channels = 48_000, 2  # decoded Opus, as s16le

    def __init__(self, on_channel: Callable[[RTCDataChannel], None]) -> None:
        # No STUN or TURN servers: this machine's addresses are not reported to any server.
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        # Without this, a client that prefers another codec would send audio in that codec.
        self._connection.addTransceiver("audio", "recvonly").setCodecPreferences([_OPUS])
        self._connection.on("datachannel", on_channel)
        self._connection.on("track", self._on_track)
        self._track: MediaStreamTrack | None = None

    async def answer(self, offer: str) -> str:
        """Return the SDP answer to a client's offer. It contains all candidates.

        Raises ``UserError`` if the text is not an offer with an audio track in Opus.
        """
        if not _OPUS_LINE.search(offer):
            raise UserError(_NOT_OPUS)
        try:
            await self._connection.setRemoteDescription(RTCSessionDescription(offer, "offer"))
            for transceiver in self._connection.getTransceivers():
                is_sound = transceiver.receiver.track is self._track
                transceiver.direction = "recvonly" if is_sound else "inactive"
            await self._connection.setLocalDescription(await self._connection.createAnswer())
        except Exception as error:  # aiortc raises various types for malformed lines
            raise UserError(f"cannot answer this SDP offer: {error}") from None
        if self._track is None:
            raise UserError(_NOT_OPUS)
        return self._connection.localDescription.sdp

    async def receive_audio(self) -> AsyncIterator[tuple[int, bytes, int]]:
        """Yield received audio until the connection ends.

        Up to ``MAX_CONCEALED_SAMPLES`` lost samples are concealed: the audio before the gap is
        repeated and fades out. Packets that arrive after a later packet are dropped.

        Yields
        ------
            Number of missing samples per channel before this audio, PCM, number of its samples.
        """
        expected: int | None = None
        pcm = b""
        while self._track is not None:
            timeout_s = CONNECT_TIMEOUT_S if expected is None else None
            try:
                frame = await asyncio.wait_for(self._track.recv(), timeout_s)
            except (MediaStreamError, TimeoutError):
                return
            if not isinstance(frame, AudioFrame) or frame.pts is None:
                continue
            lost = 0 if expected is None else (frame.pts - expected) % _TIMESTAMP_RANGE
            if lost > _TIMESTAMP_RANGE - MAX_GAP_SAMPLES:  # the packet is late
                continue
            expected = frame.pts + frame.samples
            if 0 < lost <= MAX_CONCEALED_SAMPLES:
                yield 0, self._fade_out(pcm, lost), lost
                lost = 0
            pcm = bytes(frame.planes[0])[: frame.samples * self.num_channels * 2]
            yield lost if lost <= MAX_GAP_SAMPLES else 0, pcm, frame.samples

    def _fade_out(self, pcm: bytes, num_samples: int) -> bytes:
        """Return PCM repeated to a number of samples, each repetition half as loud."""
        samples = np.frombuffer(pcm, "<i2").reshape(-1, self.num_channels)
        num_repeats = -(-num_samples // len(samples))
        faded = np.concatenate([samples * 0.5**n for n in range(1, num_repeats + 1)])
        return faded[:num_samples].astype("<i2").tobytes()

    async def close(self) -> None:
        """End the connection."""
        with contextlib.suppress(Exception):  # the connection may never have been complete
            await self._connection.close()

    def _on_track(self, track: MediaStreamTrack) -> None:
        if track.kind == "audio" and self._track is None:
            self._track = track
