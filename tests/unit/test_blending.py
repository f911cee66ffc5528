"""Dominance, blending, full model, parameters: Li et al. 2011, eq. 5-11; Wang and Cai, eq. 6-7."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.dominance import log_closure
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone
from tests.lips import INVENTORY, phone

PARAMETERS = initial_parameters()  # independent of training
JAW = MOUTH_FAPS.index(3)


def phones(text: str, start_s: float = 0.5) -> list[Phone]:
    """Return consecutive phones from text such as "b:0.08 a:0.2"."""
    new_phones: list[Phone] = []
    for word in text.split():
        symbol, duration = word.split(":")
        new_phones.append(phone(len(new_phones), symbol, start_s, float(duration)))
        start_s += float(duration)
    return new_phones


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
    alone = replace(timeline, silence_start_s=np.zeros(0), silence_end_s=np.zeros(0))
    np.testing.assert_allclose(blend(p, alone, np.array([time_s]))[0], want)


def test_longer_pauses_relax_the_mouth_more() -> None:
    jaw = [
        curve(f"a:0.2 sil:{pause} a:0.2", np.array([0.7 + pause / 2.0]))[0, JAW]
        for pause in (0.04, 0.1, 0.2, 0.4)
    ]
    held = curve("a:0.2 a:0.2", np.array([0.7]))[0, JAW]
    assert held == pytest.approx(PARAMETERS.target[VISEME_INDEX["a"], JAW], rel=0.02)
    assert held > jaw[0] > jaw[1] > jaw[2] > jaw[3]
    assert jaw[3] < 0.05 * held


def array(*values: float) -> NDArray[np.float64]:
    return np.array(values)


def test_closure_has_the_ends_of_wang_and_cai_eq_7() -> None:
    viseme, others = array(-1.0, -1.0, -1.0), array(2.0, 2.0, 2.0)
    log_weight = log_closure(
        viseme, others, array(0.07, 0.0, -0.2), reach_s=0.07, closure_ratio=25.0
    )
    np.testing.assert_allclose(log_weight, [-1.0, math.log(25.0) + 2.0, -1.0])
