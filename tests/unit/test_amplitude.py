"""Mouth openings scale with level and rate."""

import math

import numpy as np
import pytest

from kouxing.services.synthesizer.lips.dynamic_visemes.model import VisemeArticulation
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX, VISEMES
from kouxing.services.synthesizer.modifiers.amplitude import Amplitude
from kouxing.shared.phones.events import Phone
from tests.lips import LIPS, articulation_of, moment, phone

pytestmark = pytest.mark.unit

PARAMETERS = LIPS.parameters
JAW, UPPER_LIP, LOWER_LIP, WIDTH = 2, 3, 4, 5
STEP_S = 0.02


def syllables(rate_hz: float, num: int = 12) -> list[Phone]:
    """Return syllables "da" at a rate."""
    length_s = 1.0 / rate_hz
    return [
        phone(2 * k + part, symbol, 0.2 + (k + start) * length_s, share * length_s)
        for k in range(num)
        for part, (symbol, start, share) in enumerate((("d", 0.0, 0.35), ("a", 0.35, 0.65)))
    ]


def gains(articulation: VisemeArticulation, levels_db: list[float]) -> list[float]:
    """Return the gain of every frame, one level per frame."""
    amplitude = Amplitude()
    gains = []
    for k, level_db in enumerate(levels_db):
        level = (k * STEP_S, level_db)
        faps = np.zeros(68, dtype=np.float32)
        faps[[JAW, UPPER_LIP, LOWER_LIP, WIDTH]] = 100.0, -100.0, 100.0, -100.0
        amplitude.apply(faps, moment(k * STEP_S, articulation, [level], STEP_S))
        assert faps[UPPER_LIP] == -faps[JAW]
        assert faps[LOWER_LIP] == 100.0  # pressed lips stay pressed
        assert faps[WIDTH] == -100.0
        gains.append(float(faps[JAW]) / 100.0)
    return gains


def test_louder_speech_opens_further_at_any_microphone_gain() -> None:
    vowel = [phone(0, "a", 0.0, 9.0)]
    articulation = articulation_of(vowel)
    for microphone_db in (-40.0, -20.0):
        levels = [microphone_db] * 300 + [microphone_db + 8.0] * 25 + [microphone_db - 8.0] * 25
        gain = gains(articulation, levels)
        assert gain[299] == pytest.approx(1.0, abs=0.02)
        assert gain[324] > 1.15
        assert gain[349] < 0.85
        assert np.abs(np.diff(gain[290:])).max() < 0.2


def test_the_usual_level_of_a_viseme_changes_nothing() -> None:
    articulation = articulation_of(syllables(4.0, num=30))
    timeline = articulation.timeline
    usual = {viseme: float(PARAMETERS.level_db[VISEME_INDEX[viseme]]) for viseme in "da"}
    assert usual["a"] > usual["d"] + 3.0
    assert PARAMETERS.level_db.shape == (len(VISEMES),)
    levels = []
    for k in range(350):
        middle_s = (timeline.apex_start_s + timeline.apex_end_s) / 2.0
        near = timeline.viseme[np.argmin(np.abs(middle_s - k * STEP_S))]
        levels.append(-30.0 + usual[VISEMES[near]])
    gain = gains(articulation, levels)[150:]
    assert max(gain) - min(gain) < 0.05
    flat = gains(articulation, [-30.0] * 350)[150:]  # a vowel as quiet as its consonant
    assert max(flat) - min(flat) > 0.1


def test_fast_speech_opens_less() -> None:
    slow, usual, fast = (
        gains(articulation_of(syllables(rate_hz)), [math.nan] * 100)[60]
        for rate_hz in (3.0, 5.0, 8.0)
    )
    assert slow == pytest.approx(1.06, abs=0.01)
    assert usual == pytest.approx(1.0, abs=0.01)
    assert fast == pytest.approx(0.91, abs=0.01)
