"""The memory of a speaking session in the recognizer: small, and it does not grow."""

import weakref

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.live.stream import SpeechStream
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.monitoring.metrics import memory_mb, trim_heap
from tests.system import DEMO

pytestmark = pytest.mark.slow

NUM_SESSIONS = 4
CHUNK = 320  # samples: 20 ms
MAX_MB = 4.0  # limit for a session
MAX_GROWTH_MB = 0.15  # limit for a session, from one round to the next


class Sessions:
    """Streams that speak at the same time; random groups of them are decoded together."""

    def __init__(self, model: AcousticModel) -> None:
        self._recognizer = Recognizer(model)
        self._lips = load_lip_predictor()
        sound = to_16_khz(*read_audio(DEMO / "bilabials-female.wav"))[:16_000]
        self._sounds = [np.roll(sound, number * 4_000) for number in range(NUM_SESSIONS)]
        self._rng = np.random.default_rng(0)
        self._streams: list[SpeechStream] = []

    def start(self) -> None:
        recognizer = self._recognizer
        self._streams = [
            recognizer.create_stream(lip_predictor=self._lips) for _ in range(NUM_SESSIONS)
        ]

    def end(self) -> list[weakref.ref[SpeechStream]]:
        streams = [weakref.ref(stream) for stream in self._streams]
        self._streams.clear()
        return streams

    def speak_a_round(self) -> None:
        for begin in range(0, len(self._sounds[0]), CHUNK):
            order = self._rng.permutation(len(self._streams))
            for group in np.split(order, [self._rng.integers(len(order) + 1)]):
                streams = [self._streams[number] for number in group]
                for number, stream in zip(group, streams, strict=True):
                    stream.accept_waveform(self._sounds[number][begin : begin + CHUNK])
                self._recognizer.decode_streams(streams)
                for stream in streams:
                    stream.take_results()


def used_mb() -> float:
    """Return the memory of this process, without the C library's free memory."""
    trim_heap()
    return memory_mb()


def test_a_speaking_session_needs_less_than_4_mb() -> None:
    model = load_model("blocks")
    sessions = Sessions(model)
    sessions.start()
    sessions.speak_a_round()
    ended = sessions.end()
    assert not any(stream() for stream in ended), "reference cycles keep memory for long"
    before_mb = used_mb()
    sessions.start()
    used = []
    for _ in range(2):
        sessions.speak_a_round()
        used.append(used_mb())
    used_mb_per_session = [(mb - before_mb) / NUM_SESSIONS for mb in used]
    assert max(used_mb_per_session) < MAX_MB, used_mb_per_session
    assert used_mb_per_session[-1] - used_mb_per_session[0] < MAX_GROWTH_MB, used_mb_per_session
    sessions.end()
    assert used_mb() - before_mb < MAX_MB
