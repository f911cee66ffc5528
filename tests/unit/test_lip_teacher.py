"""The teacher of lips, on made-up speech."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import as_integers
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.lip_predictor import LIP_FAPS, NUM_OUTPUTS
from kouxing.training.lips import teacher
from kouxing.training.lips.positions import Speech
from kouxing.training.lips.recipe import DELAYS_S
from kouxing.training.lips.recurrent import Example
from kouxing.training.lips.teacher import (
    TAUGHT_DELAY_S,
    draw_recordings,
    train_teacher,
)
from kouxing.training.neural.network import Shape
from kouxing.training.neural.teacher import WholeEncoder
from tests.lips import clip_of

pytestmark = pytest.mark.slow

LOWER_LIP = LIP_FAPS.index(5)
CLIP = clip_of(np.empty(0), np.empty((0, 28)))


class Loudness(WholeEncoder):
    """An encoder whose feature is the loudness of 20 ms."""

    def __init__(self) -> None:
        super().__init__(Shape(num_states=0, look_aheads=(), width=32, heads=2, inner=48))

    def features(self, samples: NDArray[np.int16]) -> NDArray[np.float16]:
        loud = np.abs(samples.astype(np.float32)).reshape(-1, 320)
        level: NDArray[np.float16] = loud.mean(axis=1, keepdims=True).astype(np.float16)
        return level


@pytest.mark.usefixtures("one_thread")
def test_learns_lips_from_the_whole_recording() -> None:
    rng = np.random.default_rng(0)
    speech, examples = [], []
    for number in range(12):
        clip = replace(
            CLIP, name=str(number), samples=rng.normal(0, 0.1, 32_000).astype(np.float32)
        )
        known_s = POSITION_S * np.arange(1, 100, dtype=np.float64) + TAUGHT_DELAY_S
        features = np.zeros((99, 1), np.float16)
        speech.append(Speech(clip=clip, features=features, known_s=known_s, speed=1.0))
        level = Loudness().features(as_integers(clip.samples))[:99].astype(np.float32)
        targets = np.full((99, len(DELAYS_S), NUM_OUTPUTS), np.nan, np.float32)
        targets[..., LOWER_LIP] = (level - level.mean()) / level.std()
        examples.append(Example(np.zeros((99, 4), np.float32), targets, 0))
    taught = train_teacher(Loudness(), speech[1:], examples[1:], DELAYS_S, num_epochs=30, seed=0)
    (label,) = taught.label(speech[:1], [examples[0].components], DELAYS_S, 1)
    now = DELAYS_S.index(TAUGHT_DELAY_S)
    made, wanted = (example.targets[:, now, LOWER_LIP] for example in (label, examples[0]))
    assert np.corrcoef(made, wanted)[0, 1] > 0.8


def test_draws_up_to_an_hour_from_each_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(teacher, "_MAX_FOLDER_S", 3.5)
    noise = np.random.default_rng(0).normal(0, 0.1, 16_000)
    for folder, number in (("one", 6), ("other", 2)):
        (tmp_path / folder).mkdir()
        for k in range(number):
            soundfile.write(tmp_path / folder / f"{k}.wav", noise, 16_000)
    (tmp_path / "other" / "MOSS-TTSD_kept_back.wav").write_bytes(b"not read")
    names = [clip.name for clip in draw_recordings([tmp_path / "one", tmp_path / "other"], 0)]
    assert [name.split()[0] for name in names] == ["one"] * 4 + ["other"] * 2
    assert len(set(names)) == 6
    again = draw_recordings([tmp_path / "one", tmp_path / "other"], 1)
    assert names != [clip.name for clip in again]
