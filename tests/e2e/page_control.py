"""A fake control that publishes a face and its sound in real time, for the page."""

import time
from typing import Any

import numpy as np
from kouxing_client.field_types import MASK_BYTES
from kouxing_client.messages import EndOfFaps, FapFrame, Phone, Sound
from numpy.typing import NDArray

from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.session import AudioChunk
from tests.fake_control import EPOCH, FakeControl

FRAME = 320  # samples; 20 ms
LOOK_AHEAD_MS = 60


class PageControl(FakeControl):
    """Control with a synthesizer that publishes the face ``shown`` in one session."""

    def __init__(self) -> None:
        self.shown: NDArray[np.float32] | None = None  # None: nothing is published
        self.look_ahead_ms = LOOK_AHEAD_MS  # between a frame and its sound
        self._symbol = "a"
        self._session = ""
        self._media_time = 0
        self._sequence = 0
        self._due_s = time.monotonic()
        super().__init__()

    def talk(self, session: str, shown: NDArray[np.float32], symbol: str) -> None:
        """Show a face in a session, and publish a phone."""
        self._session, self._symbol, self.shown = session, symbol, shown

    def samples(self, session: str) -> NDArray[np.int16]:
        """Return the audio that a session has received."""
        chunks = [chunk for chunk in [*self.audio_messages] if chunk.session == session]
        return np.frombuffer(b"".join(chunk.pcm for chunk in chunks), "<i2")

    def has_ended(self, session: str) -> bool:
        """Return whether a session has received the end of its audio."""
        return any(chunk.last for chunk in [*self.audio_messages] if chunk.session == session)

    def on_audio(self, chunk: AudioChunk, sender: Peer) -> None:
        super().on_audio(chunk, sender)
        if chunk.last:
            self.faps.send(EndOfFaps(session=chunk.session, epoch=EPOCH))

    def on_tick(self) -> None:
        while time.monotonic() >= self._due_s:  # on a busy machine, it catches up
            self._due_s += FRAME / 16000
            if self.shown is not None:
                self._publish(self.shown)

    def _publish(self, shown: NDArray[np.float32]) -> None:
        self._sequence += 1
        stamp: dict[str, Any] = {
            "session": self._session,
            "epoch": EPOCH,
            "sequence": self._sequence,
        }
        pcm = self._sound().tobytes()
        self.phones.send(Sound(**stamp, media_time=self._media_time, pcm=pcm))
        self._media_time += FRAME
        frame_time = self._media_time - self.look_ahead_ms * 16
        if frame_time >= 0:
            values = shown.astype("<f4").tobytes()
            self.faps.send(
                FapFrame(
                    **stamp, media_time=frame_time, packed_values=values, mask=bytes(MASK_BYTES)
                )
            )
        if self._sequence % 10 == 0:
            self.phones.send(
                Phone(
                    **stamp,
                    media_time=self._media_time,
                    index=self._sequence // 10,
                    symbol=self._symbol,
                    duration=3200,
                    confidence=0.9,
                    final=True,
                )
            )

    def _sound(self) -> NDArray[np.int16]:
        """Return the next samples of a tone."""
        times = self._media_time + np.arange(FRAME)
        sound: NDArray[np.float64] = 3000 * np.sin(2 * np.pi * 200 / 16000 * times)
        return sound.astype(np.int16)
