"""The feeling in the voice on the face."""

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.shared.face.faps import FAP_NUMBER
from kouxing.shared.phones.events import Progress, SpeechChange
from tests.lips import DELAY_S, LIPS, lip_gaps, phone

NAMES = "raise_l_m_eyebrow close_t_l_eyelid raise_l_cornerlip head_pitch open_jaw"
BROW, LID, CORNER, PITCH, JAW = (FAP_NUMBER[name] - 1 for name in NAMES.split())
FRAME_S = 0.02
CLOSED = 20.0  # FAP units between lips


def speak(feeling: float, arousal: float, valence: float) -> NDArray[np.float32]:
    """Return the frames of "bababa..." in a voice with a feeling."""
    face = FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S, feeling=feeling)
    face.process(SpeechChange(active=True, time_s=0.0))
    for number in range(20):
        face.process(phone(number, "ba"[number % 2], 0.1 + 0.15 * number, 0.15))
    frames = []
    for number in range(1, 160):
        frames += face.process(
            Progress(time_s=number * FRAME_S, level_db=-26.0, arousal=arousal, valence=valence)
        )
    return np.array([faps for _, faps in frames])


def test_arousal_moves_brows_lids_head_and_size_of_the_mouth() -> None:
    neutral, aroused, tired = (speak(1.0, arousal, 0.0) for arousal in (0.0, 0.4, -0.4))
    high, low = (faps - neutral for faps in (aroused, tired))
    assert high[-1, BROW] > 20.0
    assert low[-1, BROW] < 0.0
    assert high[-1, LID] < 0.0 < low[-1, LID]
    assert high[-1, PITCH] < 0.0 < low[-1, PITCH]
    assert aroused[:, JAW].max() > 1.1 * neutral[:, JAW].max()
    assert tired[:, JAW].max() < 0.95 * neutral[:, JAW].max()
    assert np.abs(np.diff(high[:, BROW], n=2)).max() < 1.0  # no corners


def test_valence_moves_the_corners_of_the_mouth() -> None:
    neutral, happy, sad = (speak(1.0, 0.0, valence) for valence in (0.0, 0.4, -0.4))
    assert (happy - neutral)[-1, CORNER] > 50.0
    assert (sad - neutral)[-1, CORNER] < -30.0


@pytest.mark.parametrize("arousal", [-1.0, 1.0])
@pytest.mark.parametrize("valence", [-1.0, 1.0])
def test_closures_stay_closed_and_open_lips_open(arousal: float, valence: float) -> None:
    before, after = (lip_gaps(speak(amount, arousal, valence)) for amount in (0.0, 1.0))
    closed = before <= CLOSED
    assert closed[20:].any()
    assert (after[closed] <= CLOSED + 0.01).all()
    assert (after[~closed] > CLOSED - 0.01).all()


def test_the_feeling_can_be_turned_off_and_fades_in_silence() -> None:
    np.testing.assert_array_equal(speak(0.0, 1.0, 1.0), speak(1.0, 0.0, 0.0))
    face = FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S, feeling=1.0)
    face.process(SpeechChange(active=True, time_s=0.0))
    face.process(SpeechChange(active=False, time_s=2.0))
    frames = []
    for number in range(1, 300):
        progress = Progress(time_s=number * FRAME_S, level_db=-26.0, arousal=0.4)
        frames += face.process(progress)
    brow = np.array([faps[BROW] for _, faps in frames])
    assert brow[90] > 20.0
    assert brow[-1] < 1.0
