"""Properties of the synthesizer over random phones, revisions and chunks."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.evaluation.lips.offline_visemes import synthesize
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import EDGE_S
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import CLOSURE_FAPS, VISEME_INDEX
from kouxing.services.synthesizer.lips.learned.model import LearnedLips
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import LipPositions, Phone, Progress, SoundEvent, SpeechChange
from tests import lips
from tests.lips import INVENTORY, LIPS, advance, lip_gaps, make_face

PARAMETERS = LIPS.parameters
FRAME_S = 0.02
examples = settings(max_examples=15)
few_examples = settings(max_examples=8)
CLOSED = 20.0  # FAP units: 0.5 mm on a face
CLOSED_IN_HASTE = 35.0  # recognized less than two frames before the apex
# Jaw, width and protrusion have no closures.
UNHURRIED_FAPS = (3, 6, 7, 14, 16, 17, 53, 54)
LARGEST_STEP, LARGEST_STEP_UNHURRIED, LARGEST_TURN_UNHURRIED = 250.0, 60.0, 40.0
FINE_RATE_HZ = 240.0

symbols = st.one_of(
    st.sampled_from(INVENTORY.phones), st.sampled_from(["b", "p", "m", "f", "a", "u"])
)


@st.composite
def utterances(draw: st.DrawFn, shortest_s: float = 0.03) -> list[Phone]:
    """Draw consecutive phones at any speaking rate, with pauses."""
    rate = draw(st.floats(0.4, 2.0))
    onset_s, phones = 0.3, []
    for index, symbol in enumerate(draw(st.lists(symbols, min_size=1, max_size=14))):
        duration_s = max(rate * draw(st.floats(0.03, 0.25)), shortest_s)
        phones.append(lips.phone(index, symbol, onset_s, duration_s))
        onset_s += duration_s + draw(st.sampled_from([0.0, 0.0, 0.0, 0.05, 0.4]))
    return phones


def closure_error(faps: NDArray[np.floating], time_s: NDArray[np.float64], phone: Phone) -> float:
    """Return the minimum distance of the inner lips within 20 ms of a phone's apex."""
    viseme = INVENTORY.visemes[phone.symbol][0][0]
    inner = [fap for fap in CLOSURE_FAPS[viseme] if fap < 51]
    target = PARAMETERS.target[VISEME_INDEX[viseme], [MOUTH_FAPS.index(fap) for fap in inner]]
    apex_s = phone.onset_s + min(0.5 * phone.duration_s, EDGE_S)
    near = np.abs(time_s - apex_s) <= FRAME_S + 1e-6
    return float(np.abs(faps[near][:, np.array(inner) - 1] - target).max(axis=1).min())


levels = st.lists(st.floats(-90.0, 0.0), max_size=40)


@examples
@given(phones=utterances(), levels_db=levels)
def test_the_full_model_closes_lips_at_every_rate_and_level(
    phones: list[Phone], levels_db: list[float]
) -> None:
    rate_hz = 200.0
    num_frames = math.ceil((phones[-1].onset_s + 1.0) * rate_hz)
    timed_levels = [(0.1 * k, level_db) for k, level_db in enumerate(levels_db)]
    faps = synthesize(LIPS, phones, num_frames, rate_hz, timed_levels)
    for phone in phones:
        if phone.symbol in "bpmf":
            assert closure_error(faps, np.arange(num_frames) / rate_hz, phone) < CLOSED


@examples
@given(
    phones=utterances(),
    levels_db=levels,
    delay_s=st.floats(0.0, 0.3),
    notice_s=st.floats(0.02, 0.3),
)
def test_live_lips_close_for_phones_recognized_before_the_apex(
    phones: list[Phone], levels_db: list[float], delay_s: float, notice_s: float
) -> None:
    apexes_s = [phone.onset_s + min(0.5 * phone.duration_s, EDGE_S) for phone in phones]
    events: list[tuple[float, Phone | Progress]] = [
        (apex_s - notice_s + delay_s, phone) for apex_s, phone in zip(apexes_s, phones, strict=True)
    ]
    progress = [Progress(time_s=0.1 * k, level_db=level_db) for k, level_db in enumerate(levels_db)]
    events += [(event.time_s, event) for event in progress]
    face = make_face(delay_s=delay_s)
    frames = []
    for time_s, event in sorted(events, key=lambda item: item[0]):
        frames += advance(face, time_s) + face.process(event)
    frames += advance(face, phones[-1].onset_s + 2.0 + delay_s)
    faps = np.array([faps for _, faps in frames])
    times = np.array([time_s for time_s, _ in frames])
    limit = CLOSED if notice_s >= 2.0 * FRAME_S else CLOSED_IN_HASTE
    for phone in phones:
        if phone.symbol in "bpmf":
            assert closure_error(faps, times, phone) < limit


@st.composite
def revised_utterances(draw: st.DrawFn) -> list[tuple[float, Phone | SpeechChange]]:
    """Draw the output of a bad recognizer: guesses, wrong phones, wrong times, late revisions."""
    emitted: list[tuple[float, Phone | SpeechChange]] = []
    delay_s = draw(st.floats(0.0, 0.2))
    phones = draw(utterances())
    for phone in phones:
        for _ in range(draw(st.integers(0, 2))):
            guess = replace(
                phone,
                symbol=draw(symbols),
                onset_s=phone.onset_s + draw(st.floats(-0.05, 0.05)),
                duration_s=draw(st.floats(0.0, 0.4)),
                final=False,
            )
            emitted.append((phone.onset_s + delay_s + draw(st.floats(0.0, 0.1)), guess))
        emitted.append((phone.end_s + delay_s, phone))
    if draw(st.booleans()):
        end_s = draw(st.floats(0.3, phones[-1].onset_s + 0.5))
        emitted.append((end_s + 0.2, SpeechChange(active=False, time_s=end_s)))
    emitted.sort(key=lambda item: item[0])
    return emitted


def run(
    emitted: Sequence[tuple[float, Phone | SpeechChange]],
    face: FaceAnimator,
    cuts: Sequence[float] = (),
) -> NDArray[np.float32]:
    """Return the frames of a session that also advances at ``cuts``."""
    frames = []
    stops = sorted([(time_s, None) for time_s in cuts] + list(emitted), key=lambda stop: stop[0])
    for time_s, item in stops:
        frames += advance(face, time_s)
        if item is not None:
            face.process(item)
    frames += advance(face, stops[-1][0] + 3.0)
    return np.array([faps for _, faps in frames])


@pytest.mark.slow
@few_examples
@given(
    emitted=revised_utterances(),
    cuts=st.lists(st.floats(0.0, 3.0), max_size=20),
    delay_s=st.floats(0.0, 0.3),
)
def test_any_chunking_gives_identical_frames(
    emitted: list[tuple[float, Phone | SpeechChange]], cuts: list[float], delay_s: float
) -> None:
    undivided, cut = (
        run(emitted, make_face(delay_s=delay_s, idle_motion_seed=1), at)
        for at in ((), [time_s for time_s in cuts if time_s < emitted[-1][0]])
    )
    np.testing.assert_array_equal(undivided, cut)


@few_examples
@given(emitted=revised_utterances(), delay_s=st.floats(0.0, 0.3))
def test_a_bad_recognizer_causes_no_jump(
    emitted: list[tuple[float, Phone | SpeechChange]], delay_s: float
) -> None:
    """Position and velocity cannot change much between frames 4 ms apart."""
    faps = run(emitted, make_face(delay_s=delay_s, frame_rate_hz=FINE_RATE_HZ))
    assert np.isfinite(faps).all()
    steps = np.diff(faps, axis=0)
    unhurried = steps[:, np.array(UNHURRIED_FAPS) - 1]
    assert np.abs(steps).max() < LARGEST_STEP
    assert np.abs(unhurried).max() < LARGEST_STEP_UNHURRIED
    assert np.abs(np.diff(unhurried, axis=0)).max() < LARGEST_TURN_UNHURRIED
    # slow speech exceeds the targets by up to 15 %
    hull = 1.15 * np.vstack([PARAMETERS.target, PARAMETERS.neutral])
    mouth = faps[:, np.array(MOUTH_FAPS) - 1]
    assert (mouth >= hull.min(axis=0) - 0.01).all()
    assert (mouth <= hull.max(axis=0) + 0.01).all()
    assert not faps[-1].round(1).any()  # rest at the end


@few_examples
@given(phones=utterances(), frame=st.integers(1, 100), delay_s=st.floats(0.0, 0.3))
def test_flush_rests_within_150_ms(phones: list[Phone], frame: int, delay_s: float) -> None:
    face = make_face(delay_s=delay_s)
    now_s = frame * FRAME_S + delay_s
    for phone in phones:
        if phone.onset_s + delay_s <= now_s:
            advance(face, phone.onset_s + delay_s)
            face.process(phone)
    advance(face, now_s)
    face.flush()
    after = advance(face, now_s + 0.5)
    assert after
    assert all(not faps.round(3).any() for time_s, faps in after if time_s > after[0][0] + 0.13)


def sound(seed: int) -> list[SoundEvent]:
    """Draw lip positions with pauses and losses, with phones and progress in between."""
    rng = np.random.default_rng(seed)
    events: list[SoundEvent] = []
    opening, is_speaking = 0.0, False
    for number in range(1, 60):
        now_s = number * 0.02
        if rng.random() < 0.05 or number == 5:
            is_speaking = not is_speaking
            events.append(SpeechChange(active=is_speaking, time_s=now_s))
        if rng.random() < 0.15 and number > 8:  # after lip positions, visemes do not move the mouth
            symbol = str(rng.choice(["b", "p", "m", "f", "a", "u", "t"]))
            onset_s, final = max(0.0, now_s - 0.12), bool(rng.random() < 0.5)
            events.append(lips.phone(number, symbol, onset_s, 0.08, final=final))
        if is_speaking and rng.random() < 0.9:
            opening = min(max(opening + rng.uniform(-60.0, 60.0), 0.0), 300.0)
            frame = LipPositions(
                time_s=now_s - 0.015,
                delay_s=0.0,
                faps=np.full(len(MOUTH_FAPS), opening, np.float32),
                closure=float(rng.choice([0.0, 0.01, 0.2, 0.5, 0.9, 1.0])),
                lip_to_teeth=float(rng.choice([0.0, 0.01, 0.5, 1.0])),
            )
            events.append(frame)
        events.append(Progress(time_s=now_s, level_db=-20.0))
    return events


@few_examples
@given(st.integers(0, 1000), st.sampled_from([0.0, 0.02, 0.1]))
def test_learned_lips_have_no_jumps_or_corners(seed: int, delay_s: float) -> None:
    face = FaceAnimator(LearnedLips(LIPS), frame_rate_hz=FINE_RATE_HZ, delay_s=delay_s)
    faps = np.array([faps for event in sound(seed) for _, faps in face.process(event)])
    faps = faps[:, [fap - 1 for fap in MOUTH_FAPS if fap not in (14, 44, 45, 46, 47)]]
    assert np.isfinite(faps).all()
    if len(faps) > 2:
        # closing within 20 ms is 62 per frame; a jump is five times larger
        assert np.abs(np.diff(faps, axis=0)).max() < 62.0
        assert np.abs(np.diff(faps, n=2, axis=0)).max() < 40.0


spoken = st.lists(st.sampled_from(["b", "p", "m", "f", "a", "u", "i", "t"]), min_size=1, max_size=8)
strengths = st.dictionaries(st.sampled_from([*ExpressionName]), st.floats(0.0, 1.0), max_size=4)


@examples
@given(spoken=spoken, wanted=strengths, from_s=st.floats(0.0, 1.0))
def test_expressions_do_not_open_closures(
    spoken: list[str], wanted: dict[str, float], from_s: float
) -> None:
    """Closures without expression stay closed with any expression, from the start of the sound."""
    plain, expressive = make_face(), make_face()
    for face in (plain, expressive):
        face.process(SpeechChange(active=True, time_s=0.2))
        for index, symbol in enumerate(spoken):
            face.process(lips.phone(index, symbol, 0.4 + 0.12 * index, 0.12))
    begun = advance(expressive, from_s)
    expressive.set_expressions(wanted, 60.0)
    frames = advance(plain, 2.0), begun + advance(expressive, 2.0)
    from_sound = round(0.3 / FRAME_S)
    before, after = (
        lip_gaps(np.array([faps for _, faps in shown])[from_sound:]) for shown in frames
    )
    closed = before <= CLOSED
    assert (after[closed] <= before[closed] + 0.01).all()
    assert (after[~closed] >= CLOSED - 0.01).all()
