"""Properties of expressions over random phones and strengths."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.phones.events import SpeechChange
from tests.lips import advance, lip_gaps, make_face, phone

CLOSED = 20.0  # FAP units between lips
FRAME_S = 0.02

symbols = st.lists(
    st.sampled_from(["b", "p", "m", "f", "a", "u", "i", "t"]), min_size=1, max_size=8
)
strengths = st.dictionaries(st.sampled_from([*ExpressionName]), st.floats(0.0, 1.0), max_size=4)


def frames_of(face: FaceAnimator, until_s: float) -> NDArray[np.float32]:
    return np.array([faps for _, faps in advance(face, until_s)])


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
    neutral = frames_of(plain, 2.0)
    begun = frames_of(expressive, from_s)
    expressive.set_expressions(wanted, 60.0)
    mixed = np.concatenate([begun.reshape(-1, NUM_FAPS), frames_of(expressive, 2.0)])
    from_sound = slice(round(0.3 / FRAME_S), None)
    before, after = lip_gaps(neutral)[from_sound], lip_gaps(mixed)[from_sound]
    closed = before <= CLOSED
    assert (after[closed] <= before[closed] + 0.01).all()
    assert (after[~closed] >= CLOSED - 0.01).all()
