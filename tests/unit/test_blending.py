"""Dominance, blending, full model, parameters: Li et al. 2011, eq. 5-11; Wang and Cai, eq. 6-7."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.full_model import synthesize
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import (
    active_visemes,
    blend,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.dominance import (
    log_closure,
    log_dominance,
    log_left_silence,
    log_pause,
    log_right_silence,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    VisemeParameters,
    load_parameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    VISEME_INDEX,
    static_targets,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.training.visemes.recipe import save_parameters
from tests.lips import INVENTORY, phone

pytestmark = pytest.mark.unit

PARAMETERS = initial_parameters()  # independent of training
JAW = MOUTH_FAPS.index(3)
LOWER_LIP = MOUTH_FAPS.index(5)


def phones(text: str, start_s: float = 0.5) -> list[Phone]:
    """Return consecutive phones from text such as "b:0.08 a:0.2"."""
    made: list[Phone] = []
    for word in text.split():
        symbol, duration = word.split(":")
        made.append(phone(len(made), symbol, start_s, float(duration)))
        start_s += float(duration)
    return made


def curve(text: str, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return blend(PARAMETERS, build_timeline(phones(text), INVENTORY), time_s)


def test_two_visemes_match_a_manual_calculation() -> None:
    # Li 2011, eq. 11, as quotients
    p = PARAMETERS
    timeline = build_timeline(phones("e:0.1 i:0.12"), INVENTORY)
    first, second = (VISEME_INDEX[shape] for shape in "ei")
    time_s = 0.6
    d_first = p.alpha[first] * np.exp(
        -p.theta_plus[first] * np.abs(0.55 + p.offset_s[first] - time_s) ** p.c
    )
    d_second = p.alpha[second] * np.exp(
        -p.theta_minus[second] * np.abs(0.66 + p.offset_s[second] - time_s) ** p.c
    )
    # the time is after the first apex and before the second apex
    assert (np.abs(p.offset_s[[first, second]]) < 0.05).all()
    want = (d_second * p.target[second] + d_first * p.target[first]) / (d_second + d_first)
    alone = dataclasses.replace(timeline, silence_start_s=np.zeros(0), silence_end_s=np.zeros(0))
    np.testing.assert_allclose(blend(p, alone, np.array([time_s]))[0], want)


def test_fast_speech_misses_its_targets() -> None:
    slow = curve("d:0.12 a:0.24 d:0.12", np.array([0.74]))
    fast = curve("d:0.04 a:0.08 d:0.04", np.array([0.58]))
    assert fast[0, JAW] < 0.9 * slow[0, JAW]


def test_longer_pauses_relax_the_mouth_more() -> None:
    jaw = [
        curve(f"a:0.2 sil:{pause} a:0.2", np.array([0.7 + pause / 2.0]))[0, JAW]
        for pause in (0.04, 0.1, 0.2, 0.4)
    ]
    held = curve("a:0.2 a:0.2", np.array([0.7]))[0, JAW]
    assert held == pytest.approx(PARAMETERS.target[VISEME_INDEX["a"], JAW], rel=0.02)
    assert held > jaw[0] > jaw[1] > jaw[2] > jaw[3]
    assert jaw[3] < 0.05 * held


def test_mouth_is_at_rest_far_from_speech() -> None:
    got = curve("d:0.1 a:0.2 b:0.1", np.array([-1e6, 0.0, 3.0, 1e6]))
    np.testing.assert_allclose(got, np.tile(PARAMETERS.neutral, (4, 1)), atol=1e-6)


def test_selects_the_pair_and_visemes_within_reach() -> None:
    timeline = build_timeline(
        phones("d:0.1 a:0.1 j:0.1 i:0.1 g:0.1"), INVENTORY
    )  # apexes 0.55, 0.65, ...
    assert active_visemes(timeline, 0.62, 0.0).tolist() == [True, True, False, False, False]
    assert active_visemes(timeline, 0.67, 0.0).tolist() == [False, True, True, False, False]
    assert active_visemes(timeline, 0.67, 0.15).tolist() == [True, True, True, False, False]
    assert active_visemes(timeline, 0.67, 0.3).all()
    assert active_visemes(timeline, 0.0, 0.0).tolist() == [True, False, False, False, False]
    assert active_visemes(timeline, 9.0, 0.0).tolist() == [False, False, False, False, True]


def test_full_model_does_not_depend_on_block_size() -> None:
    spoken = phones("d:0.1 a:0.2 sil:0.3 b:0.1 iao:0.2 " * 8)
    lips = DynamicVisemes(PARAMETERS, INVENTORY)
    faps = synthesize(lips, spoken, 500)
    whole = blend(PARAMETERS, build_timeline(spoken, INVENTORY), np.arange(500) / 50.0)
    unscaled = [fap for fap in MOUTH_FAPS if fap in (6, 7, 12, 13, 14, 16, 17, 53, 54)]
    columns = [MOUTH_FAPS.index(fap) for fap in unscaled]
    np.testing.assert_allclose(faps[:, np.array(unscaled) - 1], whole[:, columns], atol=0.01)
    assert synthesize(lips, [], 3).shape == (3, 68)


def test_parameters_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "parameters.json"
    parameters = initial_parameters()
    save_parameters(parameters, path, "a test")
    again = load_parameters(path)
    for field in dataclasses.fields(VisemeParameters):
        np.testing.assert_allclose(
            getattr(again, field.name), getattr(parameters, field.name), rtol=1e-6
        )
    np.testing.assert_array_equal(again.target, static_targets())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("format", "something else"),
        ("c", 7.0),
        ("c", None),
        ("closure_ratio", 5.0),
        ("faps", [1, 2]),
        ("silence", {}),
        ("visemes", []),
        ("learnt_from", None),
        ("alpha", [float("nan")]),
    ],
)
def test_rejects_bad_parameter_files(tmp_path: Path, key: str, value: object) -> None:
    path = tmp_path / "parameters.json"
    save_parameters(initial_parameters(), path, "a test")
    data = json.loads(path.read_text())
    (data["visemes"]["a"] if key == "alpha" else data)[key] = value
    for text in (json.dumps(data), "no JSON"):
        path.write_text(text)
        with pytest.raises(UserError, match=r"parameters\.json"):
            load_parameters(path)


def array(*values: float) -> NDArray[np.float64]:
    return np.array(values)


def test_viseme_matches_a_manual_calculation() -> None:
    # alpha 2, theta 3 before the apex and 5 after it, c 1.5
    got = np.exp(log_dominance(array(0.25, 0.0, -0.25), array(2.0), array(3.0), array(5.0), 1.5))
    want = [2.0 * math.exp(-3.0 * 0.125), 2.0, 2.0 * math.exp(-5.0 * 0.125)]
    np.testing.assert_allclose(got, want)


@pytest.mark.parametrize(("model", "sign"), [(log_left_silence, 1.0), (log_right_silence, -1.0)])
def test_silence_falls_or_grows_with_time(
    model: Callable[..., NDArray[np.float64]], sign: float
) -> None:
    # sigma = t_l - t: positive before the apex
    got = np.exp(model(array(0.25, 0.0, -0.25), array(2.0), array(3.0), 1.5))
    np.testing.assert_allclose(got, 2.0 * np.exp(sign * array(0.375, 0.0, -0.375)))


def test_log_weights_are_finite_far_away() -> None:
    far, one = array(1e6, -1e6), array(1.0)
    for weights in (
        log_dominance(far, one, 40.0 * one, 40.0 * one, 1.3),
        log_left_silence(far, one, 40.0 * one, 1.3),
        log_right_silence(far, one, 40.0 * one, 1.3),
    ):
        assert np.isfinite(weights).all()


def test_silence_vanishes_between_touching_phones() -> None:
    strength = [float(log_pause(array(0.0), array(0.0), array(s))[0]) for s in (1e-6, 0.05, 0.5)]
    assert strength[0] < -10.0 < strength[1] < strength[2]
    # the intersection is never above the lower model
    assert float(log_pause(array(3.0), array(-2.0), array(1.0))[0]) <= -2.0


def test_closure_has_the_ends_of_wang_and_cai_eq_7() -> None:
    viseme, others = array(-1.0, -1.0, -1.0), array(2.0, 2.0, 2.0)
    got = log_closure(viseme, others, array(0.07, 0.0, -0.2), reach_s=0.07, closure_ratio=25.0)
    np.testing.assert_allclose(got, [-1.0, math.log(25.0) + 2.0, -1.0])
