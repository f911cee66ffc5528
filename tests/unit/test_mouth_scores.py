"""Scores of mouth profiles: which speakers, on what, after learning from how much."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips import voices
from kouxing.evaluation.lips.voices import score_voices
from kouxing.services.mouth_profiles.learning import FilmedSpeech, Observations, apply_profile
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lips import LipPredictor
from kouxing.services.recognizer.mouth_profile import MouthProfile
from kouxing.shared.errors import UserError
from tests.lip_predictors import made_up_model

pytestmark = pytest.mark.unit
MODEL = made_up_model()
RNG = np.random.default_rng(0)
PROFILE = MouthProfile(
    scale=np.ones(15, np.float32),
    offset=np.zeros(15, np.float32),
    residual=RNG.normal(0, 50, MODEL.residual_shape).astype(np.float32),
)


def clip(speaker: str, seconds: float, *, licence: str = "none", part: str = "choice") -> LipClip:
    return LipClip(
        name=f"{speaker}_{part}_{seconds}",
        speaker=speaker,
        licence=licence,
        language="zh",
        part=part,
        is_in_sync=True,
        transcript="",
        time_s=np.zeros(1),
        faps=np.zeros((1, 28)),
        samples=np.zeros(round(16_000 * seconds), np.float32),
    )


def observe(_model: object, _lips: object, filmed: FilmedSpeech) -> Observations:
    """Observe a speaker who has this mouth and never pauses."""
    num_positions = len(filmed.samples) // 320
    num_hidden, *shape = MODEL.residual_shape
    predicted = 30 * RNG.normal(size=(num_positions, *shape)).astype(np.float32)
    hidden = RNG.normal(size=(num_positions, num_hidden)).astype(np.float32)
    known_s = 0.02 * np.arange(num_positions, dtype=np.float64)
    tracked = 30 * RNG.normal(size=predicted.shape)
    speech = Observations(known_s=known_s, predicted=predicted, hidden=hidden, tracked=tracked)
    tracked += apply_profile(PROFILE, speech)
    return speech


CLIPS = [
    *[clip("one", seconds, part=part) for part in ("held", "choice") for seconds in (9, 10, 11)],
    clip("two", 60.0),
    clip("brief", 20.0),
    clip("trained", 60.0, licence="CC0", part="train"),
]


@pytest.fixture(autouse=True)
def made_up_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    def models(_path: Path) -> tuple[NeuralModel | None, LipPredictor]:
        return None, MODEL

    monkeypatch.setattr(voices, "read_clips", lambda *_, **__: CLIPS)
    monkeypatch.setattr(voices, "load_models", models)
    monkeypatch.setattr(voices, "observe", observe)


def test_strangers_with_enough_speech_are_scored_on_what_was_not_learnt_from() -> None:
    scores = score_voices(Path(), Path())
    amounts = [(score.speaker, score.learnt_s, score.held_s) for score in scores]
    assert amounts == [("one", 20, 30), ("one", 30, 30), ("two", 20, 24), ("two", 36, 24)]
    for score in scores:
        assert score.after["opening"] > score.before["opening"] + 0.1


def test_speakers_can_be_named() -> None:
    assert {score.speaker for score in score_voices(Path(), Path(), ["trained"])} == {"trained"}
    with pytest.raises(UserError, match="brief has too little speech"):
        score_voices(Path(), Path(), ["brief"])
    with pytest.raises(UserError, match="no clips in sync of nobody"):
        score_voices(Path(), Path(), ["nobody"])
