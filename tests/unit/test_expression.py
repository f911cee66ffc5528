"""Expressions ease in, stay and fade, and keep the closures of speech."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.services.synthesizer.modifiers.expression import mix
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import ExpressionName, check_expressions
from kouxing.shared.face.faps import FAP_NUMBER, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import SpeechChange
from tests.lips import LIPS, advance, make_face, phone

pytestmark = pytest.mark.unit

UPPER, LOWER = np.array([[4, 8, 9, 51, 55, 56], [5, 10, 11, 52, 57, 58]]) - 1
JAW, CORNER, BROW = 3 - 1, 12 - 1, FAP_NUMBER["raise_l_m_eyebrow"] - 1
CLOSED = 20.0  # FAP units between lips
FRAME_S = 0.02


def shown(face: FaceAnimator, until_s: float) -> NDArray[np.float32]:
    return np.array([faps for _, faps in advance(face, until_s)])


def gaps(faps: NDArray[np.float32]) -> NDArray[np.float32]:
    apart: NDArray[np.float32] = -(faps[..., UPPER] + faps[..., LOWER])
    return apart


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


def test_strengths_add_up_and_the_newest_request_counts() -> None:
    face = make_face()
    face.set_expressions({"joy": 0.4, "brow_up": 1.0}, 10.0)
    both = shown(face, 2.0)[-1]
    face.set_expressions({"joy": 0.4}, 10.0)
    joy = shown(face, 6.0)[-1]
    face.set_expressions({}, 10.0)
    none = shown(face, 10.0)[-1]
    assert both[BROW] > 40.0 > abs(joy[BROW])
    assert joy[CORNER] == pytest.approx(0.4 * 353.2, rel=0.01)
    assert both[CORNER] == pytest.approx(joy[CORNER], rel=0.01)
    assert np.abs(none).max() < 1.0


def test_surprise_opens_the_mouth_only_without_speech() -> None:
    face = make_face()
    face.set_expressions({"surprise": 1.0}, 60.0)
    assert gaps(shown(face, 3.0)[-1]).max() > 300.0
    face.process(SpeechChange(active=True, time_s=3.0))
    closing = shown(face, 3.3)
    assert gaps(closing[-1]).max() <= CLOSED
    assert closing[-1][JAW] < 5.0
    assert closing[-1][BROW] > 100.0


symbols = st.lists(
    st.sampled_from(["b", "p", "m", "f", "a", "u", "i", "t"]), min_size=1, max_size=8
)
strengths = st.dictionaries(st.sampled_from([*ExpressionName]), st.floats(0.0, 1.0), max_size=4)


@settings(max_examples=20)
@given(symbols=symbols, wanted=strengths, from_s=st.floats(0.0, 1.0))
def test_expressions_do_not_open_closures(
    symbols: list[str], wanted: dict[str, float], from_s: float
) -> None:
    """Closures without expression stay closed with any expression, from the start of the sound."""
    plain, expressive = make_face(), make_face()
    for face in (plain, expressive):
        face.process(SpeechChange(active=True, time_s=0.2))
        for index, symbol in enumerate(symbols):
            face.process(phone(index, symbol, 0.4 + 0.12 * index, 0.12))
    frames = shown(plain, 2.0)
    begun = shown(expressive, from_s)
    expressive.set_expressions(wanted, 60.0)
    mixed = np.concatenate([begun.reshape(-1, NUM_FAPS), shown(expressive, 2.0)])
    from_sound = slice(round(0.3 / FRAME_S), None)
    closed = gaps(frames)[from_sound] <= CLOSED
    assert (gaps(mixed)[from_sound][closed] <= gaps(frames)[from_sound][closed] + 0.01).all()
    assert (gaps(mixed)[from_sound][~closed] >= CLOSED - 0.01).all()


@settings(max_examples=20)
@given(wanted=strengths)
def test_expressions_keep_the_lower_lip_of_f_at_the_teeth(wanted: dict[str, float]) -> None:
    face = make_face()
    face.set_expressions(wanted, 60.0)
    expression = shown(face, 2.0)[-1]
    teeth = np.zeros(NUM_FAPS, np.float32)
    teeth[np.array(MOUTH_FAPS) - 1] = LIPS.parameters.target[VISEME_INDEX["f"]]
    mixed = teeth.copy()
    mix(mixed, expression, 0.0)
    assert (mixed[LOWER] >= teeth[LOWER] - 0.01).all()


def test_blinks_close_the_eyes_in_every_expression() -> None:
    upper, lower = FAP_NUMBER["close_t_l_eyelid"] - 1, FAP_NUMBER["close_b_l_eyelid"] - 1
    faces = make_face(idle_motion_seed=3), make_face(idle_motion_seed=3)
    faces[1].set_expressions({"joy": 1.0, "squint": 1.0}, 60.0)
    plain, squinting = (shown(face, 9.0)[100:] for face in faces)
    blink = int(plain[:, upper].argmax())
    closed = plain[blink, upper] + plain[blink, lower]
    assert squinting[blink, upper] + squinting[blink, lower] == pytest.approx(closed, abs=20.0)


@pytest.mark.parametrize(
    ("strengths", "hold_s", "named"),
    [
        ({"happy": 0.5}, 3.0, "'happy'; use joy, sadness, .*squint"),
        ({"joy": 1.5}, 3.0, "joy: strength 1.5 is not between 0 and 1"),
        ({"joy": "much"}, 3.0, "joy: strength much"),
        ({"joy": float("nan")}, 3.0, "joy: strength nan"),
        ({"joy": True}, 3.0, "joy: strength True"),
        ({"joy": 0.5}, -1.0, "hold_s is -1"),
        ({"joy": 0.5}, None, "hold_s is None"),
    ],
)
def test_rejects_invalid_expressions(
    strengths: dict[str, object], hold_s: object, named: str
) -> None:
    with pytest.raises(UserError, match=named):
        check_expressions(strengths, hold_s)
