"""Stream sessions in real time and record what a subscriber receives."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from kouxing_client import Client, FapFrame, KouxingError, Phone, Session

from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

CHUNK = MEDIA_RATE_HZ // 50  # samples: 20 ms
CHUNK_S = CHUNK / MEDIA_RATE_HZ
END_TIMEOUT_S = 15.0  # limit from the last sample to the last frame
MAX_UNPACED_FACTOR = 5.0  # maximum time for unpaced audio, relative to its duration
NUM_TRIES = 3


@dataclass(slots=True)
class ReceivedResults:
    """Results of a session in the order in which a subscriber received them."""

    frames: list[tuple[float, FapFrame]] = field(default_factory=list)  # arrival, s
    phones: list[Phone] = field(default_factory=list)
    sent_s: list[float] = field(default_factory=list)  # when each chunk was sent
    ended: bool = False
    error: str = ""  # why the session failed
    start_s: float = 0.0  # when the first sample was due
    live_until_s: float = 0.0  # when the last sample was due

    @property
    def faps(self) -> Floats:
        """FAPs of all frames, shape (frames, 68)."""
        return np.array([np.frombuffer(frame.values, "<f4") for _, frame in self.frames])

    @property
    def is_whole(self) -> bool:
        """Whether all frames and phones arrived, from one recognizer and one synthesizer."""
        last = {phone.index: phone for phone in self.phones}
        frames = [frame.sequence for _, frame in self.frames]
        return (
            self.ended
            and frames == [*range(1, len(frames) + 1)]
            and sorted(last) == [*range(len(last))]
            and all(phone.final for phone in last.values())
            and {frame.epoch for _, frame in self.frames} == {1}
        )

    def spoken_phones(self) -> list[Phone]:
        """Return the spoken phones in order."""
        return [phone for phone in self.phones if phone.is_spoken]


def speak(
    sessions: Sequence[Session],
    sound: Floats,
    *,
    paced: bool = True,
    on_step: Callable[[], None] = lambda: None,
) -> list[ReceivedResults]:
    """Stream the same audio into sessions and return what each of them received.

    The sessions take 32-bit floats at 16 kHz, in real time if ``paced``, otherwise as fast as they
    accept. ``on_step`` is called every few milliseconds.
    """
    speakers = [_Speaker(session, sound, paced=paced) for session in sessions]
    while any(speaker.is_speaking for speaker in speakers):
        for speaker in speakers:
            speaker.step(0.005 if speaker is speakers[0] else 0.0)
        on_step()
    return [speaker.received for speaker in speakers]


def speak_undisturbed(client: Client, sound: Floats) -> ReceivedResults:
    """Return what a session receives for audio without any fault; it is not paced.

    Raises ``UserError`` if results are missing every time, as on a machine that is too busy.
    """
    for _ in range(NUM_TRIES):
        session = client.open_session(encoding="f32le", paced=False)
        (received,) = speak([session], sound, paced=False)
        session.close()
        if received.is_whole:
            return received
    raise UserError("frames are missing without any fault; close other programs and try again")


class _Speaker:
    def __init__(self, session: Session, sound: Floats, *, paced: bool) -> None:
        self._session = session
        self._output = session.results(FapFrame, Phone, keep_all=True)
        pcm, size = sound.astype("<f4").tobytes(), 4 * CHUNK
        self._chunks = [pcm[start : start + size] for start in range(0, len(pcm), size)]
        self._paced = paced
        self._has_finished = False
        start_s = time.monotonic()
        length_s = len(sound) / MEDIA_RATE_HZ
        self._deadline_s = (
            start_s + length_s * (1.0 if paced else MAX_UNPACED_FACTOR) + END_TIMEOUT_S
        )
        self.received = ReceivedResults(start_s=start_s, live_until_s=start_s + length_s)

    @property
    def is_speaking(self) -> bool:
        is_late = time.monotonic() > self._deadline_s
        return not (self.received.ended or self.received.error or is_late)

    def step(self, wait_s: float) -> None:
        """Send due audio and receive results."""
        try:
            for error in self._session.take_errors():
                self.received.error = str(error)
            sent_s = self.received.sent_s
            while len(sent_s) < self._num_due():
                if not self._session.try_push(self._chunks[len(sent_s)]):
                    break
                sent_s.append(time.monotonic())
            if len(sent_s) == len(self._chunks) and not self._has_finished:
                self._session.finish()
                self._has_finished = True
            for result in self._output.available(wait_s):
                match result:
                    case FapFrame():
                        self.received.frames.append((time.monotonic(), result))
                    case Phone():
                        self.received.phones.append(result)
        except KouxingError as error:
            self.received.error = str(error)
        self.received.ended = self._output.has_ended

    def _num_due(self) -> int:
        if not self._paced:
            return len(self._chunks)
        due = int((time.monotonic() - self.received.start_s) * MEDIA_RATE_HZ) // CHUNK
        return min(due, len(self._chunks))
