"""Learned lips follow lip positions smoothly, close for closures, and rest."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.learned.closure_rule import ClosingPhones, ClosureRule
from kouxing.services.synthesizer.lips.learned.model import LearnedLips
from kouxing.services.synthesizer.lips.learned.resting_lips import CLOSE_S, HOLD_S
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import LipPositions, Phone, Progress, SpeechChange
from tests import lips
from tests.lips import INVENTORY, LIPS

MOUTH = np.array(MOUTH_FAPS) - 1
JAW, LOWER_LIP = 2, 4  # columns of FAPs 3 and 5
HEIGHTS = np.array([4, 5, 8, 9, 10, 11]) - 1  # of the inner lips
DELAY_S = 0.1
LIPS_DELAY_S = 0.085
OPEN_MOUTH = {3: 300.0} | dict.fromkeys((4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58), -200.0)


def lip_positions(time_s: float, opening: float = 1.0, closure: float = 0.0) -> LipPositions:
    faps = np.zeros(len(MOUTH_FAPS), np.float32)
    for fap, value in OPEN_MOUTH.items():
        faps[MOUTH_FAPS.index(fap)] = opening * value
    return LipPositions(
        time_s=time_s, delay_s=LIPS_DELAY_S, faps=faps, closure=closure, lip_to_teeth=0.0
    )


def phone(symbol: str, onset_s: float, confidence: float = 0.95, index: int = 0) -> Phone:
    phone = lips.phone(index, symbol, onset_s, 0.07, final=False)
    return replace(phone, confidence=confidence)


def speaking_face(lips: LipModel | None = None, delay_s: float = DELAY_S) -> FaceAnimator:
    face = FaceAnimator(lips or LearnedLips(LIPS), frame_rate_hz=50.0, delay_s=delay_s)
    face.process(SpeechChange(active=True, time_s=0.0))
    return face


def run(
    face: FaceAnimator,
    begin_s: float,
    end_s: float,
    lip_frame_at: Callable[[float], LipPositions | None],
    phones: Sequence[tuple[float, Phone]] = (),
) -> list[Frame]:
    """Process sound with lip positions 5 ms before its slices, like a recognizer's output."""
    frames = []
    for number in range(round(begin_s / 0.02) + 1, round(end_s / 0.02) + 1):
        now_s = number * 0.02
        for due_s, known in phones:
            if now_s - 0.02 < due_s <= now_s:
                face.process(known)
        lips = lip_frame_at(now_s - 0.005 - LIPS_DELAY_S)
        if lips is not None:
            frames += face.process(lips)
        frames += face.process(Progress(time_s=now_s, level_db=-20.0))
    return frames


def values(frames: Sequence[Frame], column: int) -> NDArray[np.float64]:
    return np.array([faps[column] for _, faps in frames], dtype=float)


def at(frames: Sequence[Frame], time_s: float) -> NDArray[np.float32]:
    return min(frames, key=lambda frame: abs(frame[0] - time_s))[1]


def opening_wave(time_s: float) -> LipPositions:
    return lip_positions(time_s, opening=0.5 - 0.5 * np.cos(2.0 * np.pi * 4.0 * time_s))


def closing_lips(
    closure: float, begin_s: float = 0.46, end_s: float = 0.54
) -> Callable[[float], LipPositions]:
    """Return open lips whose predicted closure is high for some time."""
    return lambda time_s: lip_positions(
        time_s, closure=closure if begin_s < time_s < end_s else 0.01
    )


def no_lip_positions(_time_s: float) -> None:
    return None


def test_follows_the_lip_positions() -> None:
    face = speaking_face()
    frames = [frame for frame in run(face, 0.0, 2.0, opening_wave) if frame[0] > 0.2]
    expected = [150.0 - 150.0 * np.cos(2.0 * np.pi * 4.0 * time_s) for time_s, _ in frames]
    assert np.abs(values(frames, JAW) - expected).max() < 0.04 * 300.0
    assert np.corrcoef(values(frames, LOWER_LIP), expected)[0, 1] < -0.999


def test_lips_stay_ajar_after_speech_and_then_close() -> None:
    face = speaking_face()
    frames = run(face, 0.0, 1.1, lip_positions)
    face.process(SpeechChange(active=False, time_s=1.0))
    frames += run(face, 1.1, 3.0, no_lip_positions)
    opening = {time_s: -float(faps[3] + faps[4]) for time_s, faps in frames}
    assert all(120.0 <= opening[time_s] <= 400.0 for time_s in opening if 0.2 < time_s < 1.8)
    assert all(opening[time_s] <= 250.0 for time_s in opening if time_s > 1.15)
    closing = [opening[time_s] for time_s in opening if time_s > 1.2]
    assert (np.diff(closing) <= 1e-4).all()
    at_rest = [faps for time_s, faps in frames if time_s > 1.0 + HOLD_S + CLOSE_S + 0.02]
    assert len(at_rest) > 20
    assert not np.array(at_rest)[:, MOUTH].any()


@pytest.mark.parametrize(
    ("closure", "confidence", "shuts"),
    [(0.1, 0.95, True), (0.1, 0.5, False), (0.003, 0.95, False), (0.95, 0.5, True)],
)
def test_prediction_and_phone_decide_a_closure_together(
    closure: float, confidence: float, shuts: bool
) -> None:
    face = speaking_face()
    frames = run(face, 0.0, 1.0, closing_lips(closure), [(0.52, phone("p", 0.46, confidence))])
    height = np.abs(at(frames, 0.5)[HEIGHTS]).max()
    assert height < 10.0 if shuts else height > 190.0


@pytest.mark.parametrize("is_flushed", [True, False])
def test_lips_do_not_pass_through_each_other_after_an_interrupted_closure(is_flushed: bool) -> None:
    face = speaking_face()
    closing = run(face, 0.0, 0.56, closing_lips(0.95))
    assert -400.0 < closing[-1][1][3] + closing[-1][1][4] < -100.0
    if is_flushed:
        face.flush()
        after = run(face, 0.56, 0.8, lip_positions)
    else:
        after = face.relax(10)
    assert all(faps[3] + faps[4] <= 0.0 for _, faps in after)


def test_a_phone_that_is_known_too_late_closes_nothing() -> None:
    sound = closing_lips(0.1, end_s=0.7)
    frames = run(speaking_face(), 0.0, 1.0, sound, [(0.64, phone("p", 0.46))])
    shown = [faps[HEIGHTS] for time_s, faps in frames if 0.4 < time_s < 0.9]
    assert np.abs(shown).max(axis=1).min() > 190.0


def test_a_long_vowel_prevents_closures_until_its_end() -> None:
    phones = ClosingPhones(INVENTORY, "b", ClosureRule(other=1.0))
    phones.add(lips.phone(0, "a", 1.0, 2.0))
    for time_s in (1.5, 2.0, 2.9):
        phones.forget_before(time_s - 0.5)
        assert phones.log_odds(time_s) == -1.0


def test_dynamic_visemes_move_the_mouth_without_lip_positions() -> None:
    phones = [(0.4, phone("d", 0.35, index=0)), (0.5, phone("a", 0.42, index=1))]
    learned, visemes = (
        run(speaking_face(lips), 0.0, 0.6, no_lip_positions, phones) for lips in (None, LIPS)
    )
    assert values(learned, JAW).max() > 50.0
    assert np.corrcoef(values(learned, JAW), values(visemes, JAW))[0, 1] > 0.99


@pytest.mark.parametrize("interruption", ["lip positions", "stall"])
def test_dynamic_visemes_move_the_mouth_continuously(interruption: str) -> None:
    face = FaceAnimator(LearnedLips(LIPS), frame_rate_hz=240.0, delay_s=DELAY_S)
    face.process(SpeechChange(active=True, time_s=0.0))
    phones = [(0.1, phone("d", 0.05, index=0)), (0.2, phone("a", 0.12, index=1))]
    frames = run(face, 0.0, 0.4, no_lip_positions, phones)
    assert values(frames, JAW)[-1] > 200.0
    if interruption == "stall":
        frames += face.relax(40) + run(face, 0.4, 0.6, no_lip_positions)
    else:
        frames += run(face, 0.4, 0.6, lambda time_s: lip_positions(time_s, opening=0.0))
    assert np.abs(np.diff(values(frames, JAW))).max() < 50.0


@pytest.mark.parametrize("to_learned", [True, False])
def test_changing_the_lip_model_is_continuous(to_learned: bool) -> None:
    models = (LIPS, LearnedLips(LIPS))
    first, second = models if to_learned else models[::-1]
    frames = []
    for changes in (True, False):
        face = FaceAnimator(first if changes else second, frame_rate_hz=240.0, delay_s=DELAY_S)
        face.process(SpeechChange(active=True, time_s=0.0))
        phones = [
            (0.02 + 0.1 * index, phone(symbol, 0.1 * index, index=index))
            for index, symbol in enumerate(["d", "a", "sh", "i", "g", "u", "d", "a", "g", "u"])
        ]
        shown = run(face, 0.0, 0.6, opening_wave, phones[:6])
        if changes:
            face.set_lip_model(second)
            face.set_lip_model(second)
        frames.append(shown + run(face, 0.6, 1.2, opening_wave, phones[6:]))
    changed = values(frames[0], JAW)
    steps = np.diff(changed)
    here = round((0.6 - DELAY_S) * 240)
    assert np.abs(np.diff(steps[here - 6 : here + 12])).max() < 15.0  # no jump, no corner
    # later it is the same as if used from the start
    np.testing.assert_allclose(changed[-60:], values(frames[1], JAW)[-60:], atol=20.0)
    assert np.abs(changed[:here] - values(frames[1], JAW)[:here]).max() > 50.0
