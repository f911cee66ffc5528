"""The linear part of the lip model, on made-up features that determine the lips."""

import numpy as np
import pytest

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.recognizer.lip_predictor import CLOSURE, LIP_FAPS, LIP_TO_TEETH, NUM_OUTPUTS
from kouxing.training.lips.linear import fit_linear
from kouxing.training.lips.positions import Speech

NUM_POSITIONS, NUM_FEATURES, NUM_DELAYS = 400, 5, 2
JAW, WIDTH, CORNER = (LIP_FAPS.index(fap) for fap in (3, 6, 59))

pytestmark = pytest.mark.usefixtures("one_thread")


def speech_of(speaker: str, features: np.ndarray) -> Speech:
    clip = LipClip(
        name=speaker,
        speaker=speaker,
        time_s=np.zeros(0),
        faps=np.zeros((0, 28)),
        samples=np.zeros(0, np.float32),
    )
    known_s = np.linspace(0.0, 8.0, len(features))
    return Speech(clip=clip, features=features.astype(np.float16), known_s=known_s, speed=1.0)


def test_follows_each_speaker_in_its_own_units() -> None:
    rng = np.random.default_rng(0)
    speech, targets = [], []
    for speaker, size, offset in (("anna", 100.0, 300.0), ("berta", 10.0, -50.0)):
        features = rng.normal(size=(NUM_POSITIONS, NUM_FEATURES))
        target = np.zeros((NUM_POSITIONS, NUM_DELAYS, NUM_OUTPUTS), np.float32)
        target[..., JAW] = size * features[:, :1] + offset
        target[..., WIDTH] = np.nan
        target[: NUM_POSITIONS // 2, :, CORNER] = np.nan
        target[NUM_POSITIONS // 2 :, :, CORNER] = features[NUM_POSITIONS // 2 :, 2:3]
        target[..., CLOSURE] = features[:, 1:2] > 0.5
        speech.append(speech_of(speaker, features))
        targets.append(target)
    weights, bias = fit_linear(speech, targets, [1.0, 2.0])
    made = np.concatenate([one.features for one in speech]) @ weights[:, 1] + bias[1]
    features = np.concatenate([one.features for one in speech])
    assert np.corrcoef(made[:, JAW], features[:, 0])[0, 1] > 0.99
    assert np.corrcoef(made[:, CORNER], features[:, 2])[0, 1] > 0.99
    assert 0.7 < made[:, JAW].std() < 1.0  # standardized, and reduced by the ridge
    assert abs(made[:, JAW].mean()) < 0.1
    assert not made[:, [WIDTH, LIP_TO_TEETH]].any()
    closes = made[:, CLOSURE] > 0.0
    assert np.mean(closes == (features[:, 1] > 0.5)) > 0.9
