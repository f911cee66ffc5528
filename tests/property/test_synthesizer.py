"""Properties of the synthesizer over random units, revisions and chunks."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.synthesizer.blending import blend, log_weights, softmax
from services.synthesizer.full import synthesize
from services.synthesizer.live import LiveSynthesizer
from services.synthesizer.parameters import load_parameters
from services.synthesizer.timeline import EDGE_S, build_timeline
from services.synthesizer.visemes import CLOSURE_FAPS, MOUTH_FAPS, SHAPES, VISEME_INDEX
from shared.fap_file import FapAnimation, read_fap, write_fap
from shared.faps import NUM_FAPS
from shared.phones import UNITS, Phone, SpeechChange

pytestmark = pytest.mark.property

PARAMETERS = load_parameters()
FRAME_S = 0.02
examples = settings(max_examples=40, deadline=None, derandomize=True)
few_examples = settings(max_examples=12, deadline=None, derandomize=True)
CLOSED = 20.0  # FAP units: half a millimetre on a face
# One step of a frame: from wide open to shut within the 20 ms that are left when a closure is
# recognised at the last moment.
LARGEST_STEP = 900.0
# Jaw, width and protrusion have no closure to catch.
UNHURRIED_FAPS = (3, 6, 7, 14, 16, 17, 53, 54)
FINE_RATE_HZ = 240.0
LARGEST_FINE_STEP, LARGEST_FINE_STEP_UNHURRIED, LARGEST_FINE_TURN_UNHURRIED = 250.0, 60.0, 40.0

units = st.one_of(st.sampled_from(UNITS), st.sampled_from(["b", "p", "m", "f", "a", "u"]))


@st.composite
def utterances(draw: st.DrawFn, shortest_s: float = 0.03) -> list[Phone]:
    """Units one after the other, at any speaking rate, with pauses."""
    rate = draw(st.floats(0.4, 2.0))
    onset_s, phones = 0.3, []
    for index, unit in enumerate(draw(st.lists(units, min_size=1, max_size=14))):
        duration_s = max(rate * draw(st.floats(0.03, 0.25)), shortest_s)
        phones.append(
            Phone(
                index=index,
                unit=unit,
                onset_s=onset_s,
                duration_s=duration_s,
                confidence=1.0,
                final=True,
            )
        )
        onset_s += duration_s + draw(st.sampled_from([0.0, 0.0, 0.0, 0.05, 0.4]))
    return phones


def closure_error(faps: NDArray[np.floating], time_s: NDArray[np.float64], phone: Phone) -> float:
    """Least distance of the inner lips from contact within 20 ms of a unit's centre."""
    shape = SHAPES[phone.unit][0][0]
    inner = [fap for fap in CLOSURE_FAPS[shape] if fap < 51]
    target = PARAMETERS.target[VISEME_INDEX[shape], [MOUTH_FAPS.index(fap) for fap in inner]]
    centre_s = phone.onset_s + min(0.5 * phone.duration_s, EDGE_S)
    near = np.abs(time_s - centre_s) <= FRAME_S + 1e-6
    return float(np.abs(faps[near][:, np.array(inner) - 1] - target).max(axis=1).min())


@examples
@given(phones=utterances(), time_s=st.floats(-1e6, 1e6))
def test_weights_sum_to_one_and_curves_stay_in_the_hull_of_the_targets(
    phones: list[Phone], time_s: float
) -> None:
    timeline = build_timeline(phones)
    times = np.array([time_s, 0.3, 0.5, 1.0])
    if len(timeline.viseme):
        weights = softmax(log_weights(PARAMETERS, timeline, times))
        np.testing.assert_allclose(weights.sum(axis=0), 1.0)
    curve = blend(PARAMETERS, timeline, times)
    hull = np.vstack([PARAMETERS.target, PARAMETERS.neutral])
    assert (curve >= hull.min(axis=0) - 1e-6).all()
    assert (curve <= hull.max(axis=0) + 1e-6).all()


levels = st.lists(st.floats(-90.0, 0.0), max_size=40)


@examples
@given(phones=utterances(), levels_db=levels)
def test_full_model_closes_the_lips_at_every_rate_and_level(
    phones: list[Phone], levels_db: list[float]
) -> None:
    rate_hz = 200.0
    num_frames = math.ceil((phones[-1].onset_s + 1.0) * rate_hz)
    heard = [(0.1 * k, level_db) for k, level_db in enumerate(levels_db)]
    faps = synthesize(PARAMETERS, phones, num_frames, rate_hz, heard)
    for phone in phones:
        if phone.unit in "bpmf":
            assert closure_error(faps, np.arange(num_frames) / rate_hz, phone) < CLOSED


@examples
@given(
    phones=utterances(),
    levels_db=levels,
    look_ahead_s=st.floats(0.0, 0.3),
    notice_s=st.floats(0.02, 0.3),
)
def test_live_closes_the_lips_when_told_before_the_centre(
    phones: list[Phone], levels_db: list[float], look_ahead_s: float, notice_s: float
) -> None:
    live = LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s)
    for k, level_db in enumerate(levels_db):
        live.accept_level(0.1 * k, level_db)
    frames = []
    for phone in phones:
        centre_s = phone.onset_s + min(0.5 * phone.duration_s, EDGE_S)
        frames += live.advance(centre_s - notice_s + look_ahead_s)
        live.accept_phone(phone)
    frames += live.advance(phones[-1].onset_s + 2.0)
    faps = np.array([faps for _, faps in frames])
    times = np.array([time_s for time_s, _ in frames])
    for phone in phones:
        if phone.unit in "bpmf":
            assert closure_error(faps, times, phone) < CLOSED


@st.composite
def revised_utterances(draw: st.DrawFn) -> list[tuple[float, Phone | SpeechChange]]:
    """What a bad recognizer says, and when: guesses, wrong units, shifted times, late news."""
    said: list[tuple[float, Phone | SpeechChange]] = []
    delay_s = draw(st.floats(0.0, 0.2))
    phones = draw(utterances())
    for phone in phones:
        for _ in range(draw(st.integers(0, 2))):
            guess = replace(
                phone,
                unit=draw(units),
                onset_s=phone.onset_s + draw(st.floats(-0.05, 0.05)),
                duration_s=draw(st.floats(0.0, 0.4)),
                final=False,
            )
            said.append((phone.onset_s + delay_s + draw(st.floats(0.0, 0.1)), guess))
        said.append((phone.onset_s + phone.duration_s + delay_s, phone))
    if draw(st.booleans()):
        end_s = draw(st.floats(0.3, phones[-1].onset_s + 0.5))
        said.append((end_s + 0.2, SpeechChange(active=False, time_s=end_s)))
    said.sort(key=lambda item: item[0])
    return said


def run(
    said: Sequence[tuple[float, Phone | SpeechChange]],
    live: LiveSynthesizer,
    cuts: Sequence[float] = (),
) -> NDArray[np.float32]:
    """Frames of a session, ``advance`` being called at ``cuts`` too."""
    frames = []
    stops = sorted([(time_s, None) for time_s in cuts] + list(said), key=lambda stop: stop[0])
    for time_s, item in stops:
        frames += live.advance(time_s)
        if isinstance(item, Phone):
            live.accept_phone(item)
        elif isinstance(item, SpeechChange):
            live.accept_speech(item)
    frames += live.advance(stops[-1][0] + 3.0)
    return np.array([faps for _, faps in frames])


@examples
@given(
    said=revised_utterances(),
    cuts=st.lists(st.floats(0.0, 3.0), max_size=20),
    look_ahead_s=st.floats(0.0, 0.3),
)
def test_any_chunking_gives_identical_frames(
    said: list[tuple[float, Phone | SpeechChange]], cuts: list[float], look_ahead_s: float
) -> None:
    whole, cut = (
        run(said, LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s, gesture_seed=1), at)
        for at in ((), [time_s for time_s in cuts if time_s < said[-1][0]])
    )
    np.testing.assert_array_equal(whole, cut)


@examples
@given(said=revised_utterances(), look_ahead_s=st.floats(0.0, 0.3))
def test_a_bad_recognizer_makes_no_jump(
    said: list[tuple[float, Phone | SpeechChange]], look_ahead_s: float
) -> None:
    faps = run(said, LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s))
    assert np.isfinite(faps).all()
    steps = np.diff(faps, axis=0)
    assert np.abs(steps).max() < LARGEST_STEP
    assert np.abs(np.diff(steps, axis=0)).max() < 2.0 * LARGEST_STEP
    assert np.abs(steps[:, np.array(UNHURRIED_FAPS) - 1]).max() < 260.0
    # slow speech opens the mouth by up to 15 % further than its targets
    hull = 1.15 * np.vstack([PARAMETERS.target, PARAMETERS.neutral])
    mouth = faps[:, np.array(MOUTH_FAPS) - 1]
    assert (mouth >= hull.min(axis=0) - 0.01).all()
    assert (mouth <= hull.max(axis=0) + 0.01).all()
    assert not faps[-1].round(1).any()  # rest in the end


@few_examples
@given(said=revised_utterances(), look_ahead_s=st.floats(0.0, 0.3))
def test_position_and_velocity_are_continuous(
    said: list[tuple[float, Phone | SpeechChange]], look_ahead_s: float
) -> None:
    # between frames 4 ms apart neither has time to change much, whatever is revised
    live = LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s, frame_rate_hz=FINE_RATE_HZ)
    faps = run(said, live)
    steps = np.diff(faps, axis=0)
    slow = np.array(UNHURRIED_FAPS) - 1
    assert np.abs(steps).max() < LARGEST_FINE_STEP
    assert np.abs(steps[:, slow]).max() < LARGEST_FINE_STEP_UNHURRIED
    assert np.abs(np.diff(steps[:, slow], axis=0)).max() < LARGEST_FINE_TURN_UNHURRIED


@examples
@given(said=revised_utterances(), frame=st.integers(1, 100), look_ahead_s=st.floats(0.0, 0.3))
def test_flush_is_at_rest_within_150_ms(
    said: list[tuple[float, Phone | SpeechChange]], frame: int, look_ahead_s: float
) -> None:
    live = LiveSynthesizer(PARAMETERS, look_ahead_s=look_ahead_s)
    flush_s = frame * FRAME_S
    for time_s, item in said:
        if time_s <= flush_s + look_ahead_s:
            live.advance(time_s)
            if isinstance(item, Phone):
                live.accept_phone(item)
    live.advance(flush_s + look_ahead_s)
    live.flush()
    after = live.advance(flush_s + look_ahead_s + 0.5)
    assert after
    assert all(not faps.round(3).any() for time_s, faps in after if time_s > after[0][0] + 0.13)


@examples
@given(
    values=st.lists(st.floats(-3000.0, 3000.0, width=32), min_size=66, max_size=66),
    rate_hz=st.floats(1.0, 240.0),
    name=st.text("abc 0123.\\:", max_size=20),
)
def test_fap_files_give_back_what_was_written(
    values: list[float], rate_hz: float, name: str
) -> None:
    faps = np.zeros((2, NUM_FAPS), dtype=np.float32)
    faps[1, 2:] = values
    with TemporaryDirectory() as folder:
        path = Path(folder) / "some.fap"
        write_fap(path, FapAnimation(name, rate_hz, faps))
        again = read_fap(path)
    np.testing.assert_array_equal(again.faps, faps)
    assert again.frame_rate_hz == pytest.approx(rate_hz)
    assert again.name == (" ".join(name.split()) or "kouxing")
