"""Modifiers of the face: expressions, expressiveness and amplitude."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.dynamic_visemes.model import VisemeArticulation
from kouxing.services.synthesizer.modifiers.amplitude import AmplitudeModifier
from kouxing.services.synthesizer.modifiers.expressiveness import (
    ExpressivenessModifier,
    scale_mouth,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import ExpressionName, check_expressions
from kouxing.shared.face.faps import NUM_FAPS
from tests.lips import (
    LOWER,
    UPPER,
    advance,
    articulation_of,
    frame_context,
    lip_gaps,
    make_face,
    phone,
    viseme_faps,
)

JAW, WIDTH = np.array([3, 6]) - 1
FRAME_S = 0.02


def shown(face: FaceAnimator, until_s: float) -> NDArray[np.float32]:
    return np.array([faps for _, faps in advance(face, until_s)])


@pytest.mark.parametrize("name", ExpressionName)
def test_expressions_ease_in_stay_and_fade(name: ExpressionName) -> None:
    face = make_face()
    advance(face, 1.0)
    face.set_expressions({name: 1.0}, 2.0)
    faps = shown(face, 5.0)
    moved = int(np.abs(faps).max(axis=0).argmax())
    curve = np.abs(faps[:, moved])
    full = curve[99]  # 2 s later
    assert full > 40.0
    assert curve[0] < 0.05 * full
    np.testing.assert_allclose(curve[40:100], full, rtol=0.02)
    assert curve[150] < 0.5 * full
    assert curve[-1] < 0.01 * full
    assert np.abs(np.diff(curve, n=2)).max() < 0.02 * full  # no corners


@pytest.mark.parametrize(
    ("name", "strength", "hold_s", "message"),
    [
        ("happy", 0.5, 3.0, "'happy'; use joy, sadness, .*squint"),
        ("joy", 1.5, 3.0, "joy: strength 1.5 is not between 0 and 1"),
        ("joy", "much", 3.0, "joy: strength much"),
        ("joy", float("nan"), 3.0, "joy: strength nan"),
        ("joy", True, 3.0, "joy: strength True"),
        ("joy", 0.5, -1.0, "hold_s is -1"),
        ("joy", 0.5, 0.0, "hold_s is 0.0; use more than 0"),
        ("joy", 0.5, None, "hold_s is None"),
    ],
)
def test_rejects_invalid_expressions(
    name: str, strength: object, hold_s: object, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        check_expressions({name: strength}, hold_s)


DEFAULT = SynthesizerConfig().expressiveness


def expressed(faps: NDArray[np.float32], amount: float) -> NDArray[np.float32]:
    changed = faps.copy()
    scale_mouth(changed, amount)
    return changed


@pytest.mark.parametrize("amount", [0.5, DEFAULT, 2.0])
def test_closed_lips_stay_closed(amount: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        faps = rng.normal(0.0, 150.0, NUM_FAPS).astype(np.float32)
        closed = lip_gaps(faps) <= 20.0
        changed = expressed(faps, amount)
        np.testing.assert_array_equal(changed[UPPER][closed], faps[UPPER][closed])
        np.testing.assert_array_equal(changed[LOWER][closed], faps[LOWER][closed])
        assert (lip_gaps(changed)[~closed] > 20.0 - 1e-3).all()


@pytest.mark.parametrize("viseme", ["a", "e", "i", "o", "u", "v"])
def test_the_mouth_opens_further_up_to_a_limit(viseme: str) -> None:
    opened = [expressed(viseme_faps(viseme), amount) for amount in (0.5, 0.8, 1.0, DEFAULT, 2.0)]
    middle = [float(lip_gaps(faps)[0]) for faps in opened]
    assert middle == sorted(middle)
    assert middle[0] < 0.75 * middle[2]
    assert middle[3] > 1.1 * middle[2]
    assert middle[-1] < 900.0
    assert opened[-1][JAW] < 500.0


def test_a_change_of_the_expressiveness_is_smooth() -> None:
    modifier = ExpressivenessModifier(0.5)
    jaws = []
    for k in range(60):
        modifier.amount = 0.5 if k < 5 else 2.0
        faps = viseme_faps("a")
        modifier.apply(faps, frame_context(k * FRAME_S))
        jaws.append(float(faps[JAW]))
    assert jaws[0] == expressed(viseme_faps("a"), 0.5)[JAW]
    assert jaws[-1] == pytest.approx(expressed(viseme_faps("a"), 2.0)[JAW])
    assert np.diff(jaws).max() < 0.2 * (jaws[-1] - jaws[0])


def gains(articulation: VisemeArticulation, levels_db: list[float]) -> list[float]:
    """Return the gain of every frame, one level per frame."""
    amplitude = AmplitudeModifier()
    gains = []
    for k, level_db in enumerate(levels_db):
        level = (k * FRAME_S, level_db)
        faps = np.zeros(68, dtype=np.float32)
        faps[[JAW, UPPER[0], LOWER[0], WIDTH]] = 100.0, -100.0, 100.0, -100.0
        amplitude.apply(faps, frame_context(k * FRAME_S, articulation, [level], FRAME_S))
        assert faps[UPPER[0]] == -faps[JAW]
        assert faps[LOWER[0]] == 100.0  # pressed lips stay pressed
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
