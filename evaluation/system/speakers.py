"""Many speakers in one process, with different voices and positions in the text."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from kouxing_client import Client, FapFrame, Refused, Session
from numpy.typing import NDArray

from kouxing.evaluation.system.live import CHUNK
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ

CHUNK_S = CHUNK / MEDIA_RATE_HZ
VOICES = (1.0, 0.86, 1.14, 0.93, 1.07)  # pitch and formants, relative to the recording
_OFFSET = 0.618  # from one speaker to the next, relative to the text: no two are close


def read_text(paths: Sequence[Path]) -> NDArray[np.float32]:
    """Concatenate recordings: 16 kHz mono, shape (n,).

    Raises
    ------
    UserError
        If a file is not audio.
    """
    return np.concatenate([to_16_khz(*read_audio(path)) for path in paths])


def voiced(text: NDArray[np.float32], number: int) -> NDArray[np.float32]:
    """Return the audio of a speaker: the text from another position, in another voice."""
    rotated = np.roll(text, -round(number * _OFFSET * len(text)) % len(text))
    voice = VOICES[number % len(VOICES)]
    return rotated if voice == 1.0 else to_16_khz(rotated[:, None], round(MEDIA_RATE_HZ * voice))


@dataclass(slots=True)
class Spoken:
    """A speaker's session, and the arrival times of its frames."""

    session: Session
    sound: bytes  # 16-bit samples, repeated
    start_s: float = 0.0  # when the first sample was due, by ``time.perf_counter``
    num_sent: int = 0  # chunks
    num_full: int = 0  # chunks that the queue did not accept
    num_rest: int = 0  # frames of a silent client, though the speaker was not silent
    arrived_s: dict[int, float] = field(default_factory=dict)  # first arrival, by media time

    @property
    def due_s(self) -> float:
        """When the last sample of the next chunk is due."""
        return self.start_s + (self.num_sent + 1) * CHUNK_S

    def send(self) -> None:
        """Send the next chunk."""
        size = 2 * CHUNK
        at = self.num_sent * size % (len(self.sound) // size * size)
        self.num_sent += 1
        if not self.session.try_push(self.sound[at : at + size]):
            self.session.skip(CHUNK)
            self.num_full += 1

    def record(self, frame: FapFrame) -> None:
        """Record the arrival of a frame."""
        if frame.media_time not in self.arrived_s:
            self.arrived_s[frame.media_time] = time.perf_counter()
        elif frame.media_time > 0:  # earlier, the speaker has not started
            self.num_rest += 1

    def delays_s(self, delay_s: float, from_s: float, until_s: float) -> Iterator[float]:
        """Yield the latencies of all frames whose audio was due in an interval, seconds.

        The synthesizer's delay is subtracted. Missing frames count as if they had arrived at the
        end. A chunk counts from when it was due, so a late client makes figures worse.
        """
        rate_hz = self.session.info["facts"]["frame_rate_hz"]
        for number in range(int((until_s - self.start_s) * rate_hz)):
            media_time = round(number / rate_hz * MEDIA_RATE_HZ)
            needed = -(-(media_time + round(delay_s * MEDIA_RATE_HZ)) // CHUNK)  # chunks
            due_s = self.start_s + max(1, needed) * CHUNK_S
            if from_s <= due_s < until_s:
                yield min(self.arrived_s.get(media_time, until_s), until_s) - due_s


class Crowd:
    """Sessions of one client with audio in real time, whose chunks are spread evenly.

    Parameters
    ----------
    client
        Client that opens the sessions.
    text
        Audio of ``read_text``.
    num_speakers
        Number of requested sessions.

    Attributes
    ----------
    spoken
        Admitted sessions.
    refusals
        Number of refused sessions, by code.
    lateness_s
        How late each chunk was sent.
    """

    def __init__(self, client: Client, text: NDArray[np.float32], num_speakers: int) -> None:
        self.spoken: list[Spoken] = []
        self.refusals: dict[str, int] = {}
        self.lateness_s: list[float] = []
        self._turn = 0  # index of the next speaker
        for number in range(num_speakers):
            try:
                session = client.open_session()
            except Refused as refusal:
                self.refusals[refusal.code] = self.refusals.get(refusal.code, 0) + 1
                continue
            self.spoken.append(self._follow(session, voiced(text, number)))

    def _follow(self, session: Session, sound: NDArray[np.float32]) -> Spoken:
        pcm = np.round(np.clip(sound, -1.0, 1.0) * 32767).astype("<i2").tobytes()
        spoken = Spoken(session, pcm)
        session.results(FapFrame, on_result=spoken.record)
        return spoken

    def start(self) -> None:
        """Start all speakers."""
        now_s = time.perf_counter()
        for number, spoken in enumerate(self.spoken):
            spoken.start_s = now_s + CHUNK_S * number / len(self.spoken)

    def speak_until(self, end_s: float) -> None:
        """Speak until a time of ``time.perf_counter``."""
        while (now_s := time.perf_counter()) < end_s:
            if not self.spoken:
                time.sleep(end_s - now_s)
                return
            speaker = self.spoken[self._turn]  # all chunks are equally long
            left_s = min(speaker.due_s, end_s) - now_s
            if left_s > 0.0:
                time.sleep(left_s)
            else:
                self.lateness_s.append(now_s - speaker.due_s)
                speaker.send()
                self._turn = (self._turn + 1) % len(self.spoken)
                if self._turn == 0:
                    for spoken in self.spoken:
                        spoken.session.take_errors()  # refused audio shows as missing frames

    def close(self) -> None:
        """End all sessions."""
        for spoken in self.spoken:
            spoken.session.close()
