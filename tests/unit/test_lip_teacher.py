"""The teacher of lips, on made-up speech."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.recognizer.acoustic.load import load_model
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.lip_positions import POSITION_S
from services.recognizer.lips import CLOSURE, LIP_FAPS, NUM_OUTPUTS
from shared.errors import UserError
from tests.lips import clip_of
from tests.system import DEMO
from training.lips.positions import Speech
from training.lips.recipe import DELAYS_S
from training.lips.recurrent import Example
from training.lips.teacher import TAUGHT_DELAY_S, Lessons, hear, read_recordings, teach
from training.neural.network import Shape
from training.neural.teacher import WholeEncoder

pytestmark = [pytest.mark.unit, pytest.mark.slow]

LOWER_LIP = LIP_FAPS.index(5)
CLIP = clip_of(np.empty(0), np.empty((0, 28)))


class Clock(WholeEncoder):
    """Hears nothing but what time it is."""

    def __init__(self) -> None:
        super().__init__(Shape(num_states=0, look_aheads=(), width=32, heads=2, inner=48))

    def features(self, samples: NDArray[np.int16]) -> NDArray[np.float16]:
        return POSITION_S * np.arange(1, len(samples) // 320, dtype=np.float16)[:, None]


def test_the_teacher_hears_the_moment_of_the_mouth_that_it_learns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model = load_model()
    assert isinstance(model, NeuralModel)
    (recording,) = (one for one in read_recordings([DEMO], 0) if one.name == "vowels-male.wav")
    lessons = hear(Clock(), model, [], [recording])
    assert lessons.speech
    last_s = POSITION_S * (len(recording.samples) // 320 - 1)  # nothing is heard behind it
    for speech, heard_s in zip(lessons.speech, lessons.unfilmed, strict=True):
        mouth_s = np.minimum(speech.speed * (speech.known_s - TAUGHT_DELAY_S), last_s)
        np.testing.assert_allclose(heard_s[:, 0], mouth_s, atol=0.011)


@pytest.mark.usefixtures("one_thread")
def test_labels_are_what_the_clips_taught_a_delay_ago() -> None:
    rng = np.random.default_rng(0)
    heard, speech, examples = [], [], []
    for _ in range(16):
        features = rng.normal(size=(100, 3)).astype(np.float16)
        features[:, 0] = np.convolve(features[:, 0], np.ones(5) / 2, "same")
        targets = np.full((100, len(DELAYS_S), NUM_OUTPUTS), np.nan, np.float32)
        targets[..., LOWER_LIP] = features[:, :1] / 2
        targets[..., CLOSURE] = features[:, :1] < -1
        heard.append(features)
        examples.append(Example(rng.normal(size=(100, 4)).astype(np.float32), targets, 0))
        known_s = 1.0 + POSITION_S * np.arange(100, dtype=np.float64)
        speech.append(Speech(clip=CLIP, features=features, known_s=known_s, speed=1.0))
    known = [example.components for example in examples]
    labelled = teach(
        Lessons(heard[:12], speech[12:], heard[12:]),
        examples[:12],
        known[12:],
        DELAYS_S,
        num_epochs=25,
        seed=0,
    )
    now, later = DELAYS_S.index(TAUGHT_DELAY_S), DELAYS_S.index(0.055)
    for label, truth in zip(labelled, examples[12:], strict=True):
        assert label.speaker == 1
        wanted = truth.targets[:, now, LOWER_LIP]
        assert np.corrcoef(label.targets[:, now, LOWER_LIP], wanted)[0, 1] > 0.8
        is_shut = truth.targets[:, now, CLOSURE] > 0
        closure = label.targets[:, now, CLOSURE]
        assert 0 <= closure.min() < closure[is_shut].mean() / 2 < closure.max() <= 1
        assert np.isnan(label.targets[:2, later]).all()
        np.testing.assert_allclose(label.targets[2:, later], label.targets[:-2, now], atol=1e-4)


def test_a_recording_that_is_none_is_named(tmp_path: Path) -> None:
    (tmp_path / "noise.wav").write_bytes(b"no sound")
    with pytest.raises(UserError, match=r"noise\.wav.*remove it"):
        read_recordings([tmp_path], 0)
