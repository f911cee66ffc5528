"""Scores of lips and the fit report, on artificial clips."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.corpora.figures import new_figure
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.evaluation.lips.schemes import DELAYS_S, RecognizedClip, Scheme
from kouxing.evaluation.lips.scores import ClipScore, LipScore, pool, score_clip
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import EDGE_S, build_timeline
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import Phone
from tests.lips import INVENTORY, clip_of, utterance

START = initial_parameters()
MOUTH = np.array(MOUTH_FAPS) - 1


def recognized(clip: LipClip, phones: list[Phone]) -> RecognizedClip:
    return RecognizedClip(
        clip=clip,
        num_frames=0,
        levels=level_track(clip.samples),
        events={delay_s: [] for delay_s in DELAYS_S},
        inventory=INVENTORY,
        recognized=phones,
        aligned=None,
    )


def scores_of(lips: RecognizedClip, schemes: dict[str, NDArray[np.float64]]) -> list[LipScore]:
    """Score made frames under their names."""

    def score(name: str) -> ClipScore | None:
        return score_clip(lips, Scheme(name, 0.05, lambda _clip: schemes[name]))

    return pool([result for name in schemes if (result := score(name)) is not None])


def test_measures_lag_openings_and_closures() -> None:
    phones = utterance(1, 40)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.02)
    true, made, still = np.zeros((3, len(time_s), NUM_FAPS))
    for frames, delay_s in ((true, 0.0), (made, 0.05)):
        frames[:, MOUTH] = blend(START, build_timeline(phones, INVENTORY), time_s - delay_s)
    curve = true[:, MOUTH]

    # quietest where the lips of a b are: half way, or at its edge
    samples = np.full(int(time_s[-1] * SAMPLE_RATE_HZ), 0.1, dtype=np.float32)
    for phone in phones:
        apex = round(SAMPLE_RATE_HZ * (phone.onset_s + min(phone.duration_s / 2.0, EDGE_S)))
        samples[apex - 160 : apex + 160] = 0.0
    clip = replace(clip_of(time_s, curve), samples=samples)
    scores = scores_of(recognized(clip, phones), {"late": made, "true": true, "still": still})
    groups = {("all", "all"), ("language", "zh"), ("source", "made"), ("speaker", "nobody")}
    assert {(score.kind, score.group) for score in scores} == groups
    by_scheme = {score.scheme: score for score in scores if score.kind == "all"}
    late, same, rest = (by_scheme[name] for name in ("late", "true", "still"))

    opening = late.curves["opening"]
    assert opening.best_lag_ms == 50
    assert opening.best_correlation == pytest.approx(1.0, abs=0.01)
    assert (opening.correlation or 0.0) < 0.95
    assert (opening.rmse or 0.0) > 1e-3 > (same.curves["opening"].rmse or 0.0)
    assert late.opening_delay_p50_ms == pytest.approx(50.0, abs=2.0)
    assert late.opening_delay_p95_ms == pytest.approx(50.0, abs=5.0)
    assert same.opening_delay_p95_ms == pytest.approx(0.0)
    assert same.openings_met == same.openings >= 5
    assert same.closures.real >= 3
    assert same.closures.recall == 1.0
    assert same.bpm == same.bpm_met == sum(phone.symbol == "b" for phone in phones) >= 3
    # a mouth that never opens closes nothing
    assert [curve.correlation for curve in rest.curves.values()] == [None] * 3
    assert rest.bpm_met == rest.closures.met == rest.closures.made == rest.closures.f1 == 0

    out_of_sync = recognized(replace(clip, is_in_sync=False), phones)
    score = scores_of(out_of_sync, {"true": true})[0]
    assert score.curves["opening"].correlation == pytest.approx(1.0)
    assert score.curves["opening"].best_lag_ms is None
    assert score.closures.real == score.openings == score.bpm == 0


def test_figures_need_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pip install"):
        new_figure(1.0, 1.0)
