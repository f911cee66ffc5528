"""What a speaker's own lips bring: who is scored, on what, and after learning from how much."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips import voices
from kouxing.evaluation.lips.voices import score_voices
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lips import LipPredictor
from kouxing.services.recognizer.voice import Voice
from kouxing.services.recognizer.voice_learning import Material, with_voice
from kouxing.shared.errors import UserError
from tests.lip_predictors import made_up_model

pytestmark = pytest.mark.unit
MODEL = made_up_model()
RNG = np.random.default_rng(0)
VOICE = Voice(
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


def material_of_clip(_model: object, _lips: object, spoken: LipClip) -> Material:
    """As if the speaker had said something in this voice all the time."""
    num_positions = len(spoken.samples) // 320
    num_inner, *shape = MODEL.residual_shape
    made = 30 * RNG.normal(size=(num_positions, *shape)).astype(np.float32)
    inner = RNG.normal(size=(num_positions, num_inner)).astype(np.float32)
    known_s = 0.02 * np.arange(num_positions, dtype=np.float64)
    plain = Material(known_s=known_s, made=made, inner=inner, tracked=np.zeros(made.shape))
    tracked = with_voice(VOICE, plain) + 30 * RNG.normal(size=made.shape)
    return Material(known_s=known_s, made=made, inner=inner, tracked=tracked)


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
    monkeypatch.setattr(voices, "clip_material", material_of_clip)


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
