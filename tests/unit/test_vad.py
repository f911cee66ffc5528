import numpy as np

from kouxing.services.recognizer.front_end.vad import (
    BLOCK_SAMPLES,
    VoiceActivityDetector,
    VoiceState,
)
from kouxing.shared.audio_file import read_audio
from tests.system import DEMO

HELLO = read_audio(DEMO / "hello-female.wav")[0].reshape(-1)
QUIET, SPEAKING, STOPPING = VoiceState


def states(samples: np.ndarray) -> list[VoiceState]:
    detector = VoiceActivityDetector()
    whole = len(samples) // BLOCK_SAMPLES * BLOCK_SAMPLES
    return [detector.detect(block) for block in samples[:whole].reshape(-1, BLOCK_SAMPLES)]


def test_silence_and_noise_are_not_speech() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.02, 48_000).astype(np.float32)
    clicks = noise / 20
    for begin in range(0, 48_000, 8000):
        clicks[begin : begin + 200] += rng.normal(0, 0.3, 200) * np.linspace(1, 0, 200) ** 2
    hum = (0.1 * np.sin(2 * np.pi * 50 * np.arange(48_000) / 16_000)).astype(np.float32)
    for sound in (np.zeros(48_000, np.float32), noise, noise * 10, hum, clicks):
        assert set(states(sound)) == {QUIET}


def test_detects_speech_early() -> None:
    detected = states(HELLO)
    assert detected[0] is QUIET
    assert detected.count(SPEAKING) > 0.7 * len(detected)
    # speech starts at about 0.38 s and is detected within 70 ms
    assert 0.38 < detected.index(SPEAKING) * BLOCK_SAMPLES / 16_000 < 0.45
