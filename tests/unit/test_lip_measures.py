"""Measures of mouths with known results."""

import doctest
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.corpora import scoring
from kouxing.evaluation.lips import agreement, curves, lip_measures, misalignment
from kouxing.evaluation.lips import closures as closures_module
from kouxing.evaluation.lips.agreement import agreement_of
from kouxing.evaluation.lips.closures import DetectionCounts, closures, contacts, is_closed_at
from kouxing.evaluation.lips.curves import pooled_moments
from kouxing.evaluation.lips.lip_measures import (
    ScoredClip,
    correlate_by_speaker,
    lip_intensity,
    opening_range,
)
from kouxing.evaluation.lips.misalignment import misalignment_s, warping_path
from kouxing.evaluation.lips.mouths import Mouth, predicted_mouth, real_mouth
from kouxing.evaluation.lips.references import Reference
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.lips import INVENTORY, clip_of, phone

TIME_S = np.arange(0.0, 4.0, 0.02)
Array = NDArray[np.float64]


def lips_with_opening(opening: Array) -> Mouth:
    """Return made lips with an opening at ``TIME_S``; width and jaw follow it."""
    faps = np.zeros((len(opening), NUM_FAPS))
    faps[:, 4] = -opening
    faps[:, 5] = faps[:, 2] = opening
    return predicted_mouth(faps)


def lips_closed_during(*closed: tuple[float, float], opening: float = 300.0) -> Mouth:
    """Return open lips that are closed for some spans of time, seconds."""
    curve = np.full(len(TIME_S), opening)
    for start_s, end_s in closed:
        curve[(start_s - 1e-6 <= TIME_S) & (end_s + 1e-6 >= TIME_S)] = 0.0
    return lips_with_opening(curve)


def reference(
    real: Mouth, phones: Sequence[Phone] = (), *, loud: tuple[float, float] = (0.0, 4.0)
) -> Reference:
    """Return a clip of 4 s whose sound is loud for a span of time, seconds."""
    samples = np.zeros(64_000, dtype=np.float32)
    samples[round(16_000 * loud[0]) : round(16_000 * loud[1])] = 0.1
    clip = clip_of(TIME_S, np.zeros((len(TIME_S), len(MOUTH_FAPS))))
    return Reference(
        clip=replace(clip, samples=samples),
        mouth=real,
        phones=phones,
        voice=[SpeechChange(active=True, time_s=0.0)],
        visemes=INVENTORY.visemes,
    )


@pytest.mark.parametrize(
    "module",
    [agreement, closures_module, curves, lip_measures, misalignment, scoring],
    ids=lambda module: module.__name__,
)
def test_the_examples_in_docstrings_hold(module: ModuleType) -> None:
    outcome = doctest.testmod(module)
    assert outcome.attempted
    assert not outcome.failed


def test_correlation_and_error_of_curves() -> None:
    # without means: made (-1, 0, 1), real (-1, 1, 0)
    pair = np.array([1.0, 2.0, 3.0]), np.array([10.0, 12.0, 11.0])
    moments = pooled_moments([pair, (np.array([np.nan]), np.array([1.0]))])
    assert moments.correlation == pytest.approx(0.5)
    assert moments.rmse == pytest.approx(np.sqrt(2 / 3))
    assert pooled_moments([(np.ones(3), np.arange(3.0))]).correlation is None


def test_agreement_measures_the_lag() -> None:
    curve = 150.0 + 150.0 * np.sin(2 * np.pi * TIME_S)
    real = lips_with_opening(curve)
    late = lips_with_opening(150.0 + 150.0 * np.sin(2 * np.pi * (TIME_S - 0.06)))
    agreement = agreement_of([(late, real)])
    assert agreement.lag_ms == 60
    assert agreement.correlation["opening"] == pytest.approx(np.cos(0.12 * np.pi), abs=0.01)
    assert agreement_of([(lips_closed_during(), real)]).lag_ms is None


def test_counts_missed_and_false_closures() -> None:
    real = lips_closed_during((0.5, 0.5), (1.5, 1.5), (2.5, 2.5))
    predicted = lips_closed_during((0.54, 0.56), (2.0, 2.1), (2.4, 2.46), (3.5, 3.5))
    hits = closures(predicted, real)
    assert hits == DetectionCounts(real=3, reproduced=2, predicted=4, true=2)
    assert hits.recall == pytest.approx(2 / 3)
    assert hits.precision == 0.5
    assert hits.f1 == pytest.approx(4 / 7)
    np.testing.assert_array_equal(
        is_closed_at(np.array([0.5, 1.5, 2.5]), predicted), [True, False, True]
    )
    assert (hits + hits).f1 == hits.f1
    assert hits + hits == DetectionCounts(6, 4, 8, 4)
    second = contacts(predicted, real)[1]
    assert second.time_s == pytest.approx(2.05)
    assert not second.is_true


def test_closures_after_the_end_of_the_clip_do_not_count() -> None:
    real = lips_closed_during((0.5, 0.5), (1.5, 1.5))
    predicted = lips_closed_during((0.5, 0.5), (3.5, 3.5))
    is_known = real.time_s < 3.0
    curves = {"opening": real.opening[is_known]}
    clip = Mouth(real.time_s[is_known], curves, real.is_closed[is_known])
    assert closures(predicted, clip) == DetectionCounts(real=2, reproduced=1, predicted=1, true=1)


def test_real_lips_are_closed_in_the_lowest_tenth_of_their_range() -> None:
    faps = np.zeros((4, NUM_FAPS))
    faps[:, 4] = [-100.0, -110.0, np.nan, -300.0]
    tracked = real_mouth(np.arange(4.0), faps)
    np.testing.assert_array_equal(tracked.time_s, [0.0, 1.0, 3.0])
    np.testing.assert_array_equal(tracked.is_closed, [True, True, False])


def test_closures_count_for_the_phones_around_them() -> None:
    real = lips_closed_during((0.5, 0.5), (1.5, 1.5), (2.5, 2.5))
    predicted = lips_closed_during((0.5, 0.5), (1.0, 1.0), (2.5, 2.5), (3.5, 3.5))
    phones = [phone(0, "b", 0.48), phone(1, "a", 0.6, 0.9), phone(2, "u", 2.4), phone(3, "m", 3.0)]
    clips = [ScoredClip(reference(real, phones), predicted)]
    assert lip_measures.class_precision(clips, "bpm") == 1.0
    assert lip_measures.class_precision(clips, "aei") == 0.0
    assert lip_measures.class_precision(clips, "uo") == 1.0
    assert lip_measures.class_precision(clips, "pause") == 0.0
    assert lip_measures.labial_closure_rate(clips) == 0.5  # the lips are open in m
    assert lip_measures.closed_fraction(clips) == 4 / 200


def test_lips_rest_and_close_after_the_sound() -> None:
    # sound from 1 to 2 s; the margin of speech is 0.1 s
    predicted = lips_closed_during((0.0, 0.88), (2.44, 4.0))
    quiet = reference(lips_closed_during(), loud=(1.0, 2.0))
    clips = [ScoredClip(quiet, predicted)]
    assert lip_measures.closing_time_ms(clips) == pytest.approx(440.0)
    # of 141 frames without speech, those at 0.9 s and from 2.1 to 2.42 s are open
    assert lip_measures.rest_opening(clips) == pytest.approx(300 * 18 / 141)
    rig = replace(quiet, clip=replace(quiet.clip, is_rig=True))
    assert lip_measures.rest_opening([ScoredClip(rig, predicted)]) is None
    never = lip_measures.closing_time_ms([ScoredClip(quiet, lips_closed_during())])
    assert never == pytest.approx(1980.0, abs=25.0)  # the whole pause


def test_spread_within_phones_ignores_differences_between_them() -> None:
    curve = np.select([TIME_S < 1, TIME_S < 2, TIME_S < 3], [100.0, 300.0, 500.0], 900.0)
    phones = [phone(k, symbol, k + 0.4, 0.2) for k, symbol in enumerate("aaei")]
    clips = [ScoredClip(reference(lips_with_opening(2 * curve), phones), lips_with_opening(curve))]
    assert lip_measures.phone_spread(clips) == pytest.approx(100.0)  # of a: 100 and 300


def test_turns_per_second_of_speech() -> None:
    sawtooth = lips_with_opening(30.0 * np.arange(200.0) % 300.0)
    clips = [ScoredClip(reference(lips_closed_during()), sawtooth)]
    assert lip_measures.turns_per_s(clips) == pytest.approx(38 / 4)  # 19 peaks and 19 valleys


def test_effort_correlates_within_speakers() -> None:
    # deviations of level and range: A (-1, 0, 1) and (-1, 1, 0), r = 0.5; B the same, r = 1
    levels, ranges = [0.0, 1.0, 2.0, 50.0, 60.0, 70.0], [1.0, 3.0, 2.0, 9.0, 10.0, 11.0]
    assert correlate_by_speaker([*"AAABBB"], levels, ranges) == pytest.approx(0.75)
    assert correlate_by_speaker([*"AABB"], levels[:4], ranges[:4]) is None
    assert opening_range(np.arange(101.0)) == pytest.approx(90.0)
    assert lip_intensity(lips_with_opening(np.array([0.0, 6.0, 6.0]))) == pytest.approx(
        300 / np.sqrt(2)
    )


def test_louder_clips_have_wider_and_faster_lips() -> None:
    takes = []
    for gain, extent in ((1.0, 100.0), (2.0, 300.0), (3.0, 200.0)):
        clip = reference(lips_closed_during())
        louder = replace(clip, clip=replace(clip.clip, samples=gain * clip.clip.samples))
        takes.append(ScoredClip(louder, lips_with_opening(extent * (np.arange(200.0) % 2))))
    level_db = 20 * np.log10([1.0, 2.0, 3.0])
    r_db = np.corrcoef(level_db, [100.0, 300.0, 200.0])[0, 1]
    assert lip_measures.effort_correlation(takes) == pytest.approx(r_db)
    assert lip_measures.speech_lip_intensity(takes) == pytest.approx(0.5)


def test_misalignment_of_a_late_mouth() -> None:
    assert warping_path(np.array([0.0, 1.0]), np.array([0.0, 0.0, 1.0])) == [(0, 0), (0, 1), (1, 2)]
    sines = [
        lips_with_opening(200.0 + 100.0 * np.sin(2 * np.pi * (TIME_S - lag))) for lag in (0.0, 0.1)
    ]
    assert misalignment_s(sines[1], sines[0]) == pytest.approx(0.1, abs=0.02)
    assert misalignment_s(lips_closed_during(), sines[0]) is None
