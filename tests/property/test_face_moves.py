"""Replacing the recognizer or synthesizer during speech is not visible."""

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.services.lip_models import lip_model_info
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange, Waveform
from tests.live_streams import recognize_live
from tests.system import DEMO

REPEATED_S = 3.0  # events repeated for a new synthesizer
LARGEST_STEP = 1.2  # relative to the largest undisturbed step
INVISIBLE_STEP = 1.0  # FAP units; smaller steps are invisible
CLOSED, NEARLY_CLOSED = 12.0, 35.0  # FAP units between inner lips
RATE_HZ = 50.0
JAW, EYELID, HEAD_PITCH, LOWER_LIP = 3, 19, 48, 5  # FAPs


@lru_cache
def events() -> tuple[SoundEvent, ...]:
    """Return a live recognizer's output for a sentence with many closures."""
    samples, _ = read_audio(DEMO / "bilabials-female.wav")
    model = load_model()
    outputs = recognize_live(model, samples, lip_predictor=load_lip_predictor(), face_delay_s=0.06)
    return tuple(event for event in outputs if not isinstance(event, Waveform))


def make_face(lips: str) -> FaceAnimator:
    face = FaceAnimator(
        load_lip_model(name=lips),
        frame_rate_hz=RATE_HZ,
        delay_s=lip_model_info(lips).delay_ms / 1e3,
        idle_motion=True,
        idle_motion_seed=1,
        expressiveness=1.4,
    )
    face.set_expressions({"joy": 0.7}, hold_s=3600.0)
    return face


def process_all(face: FaceAnimator, received: Sequence[SoundEvent]) -> list[Frame]:
    return [frame for event in received for frame in face.process(event)]


@lru_cache
def uninterrupted(lips: str) -> list[Frame]:
    return process_all(make_face(lips), events())


def time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s


def move_to_another_synthesizer(lips: str, cut: int) -> list[Frame]:
    """Resume on a new face: last frame, recent events, then new events."""
    before, after = events()[:cut], events()[cut:]
    frames = process_all(make_face(lips), before)
    kept_from_s = time_of(before[-1]) - REPEATED_S
    changes = [event for event in before if isinstance(event, SpeechChange)]
    older = [event for event in changes if event.time_s < kept_from_s][-1:]
    face = make_face(lips)
    face.resume(frames[-1][0], len(frames), frames[-1][1])
    repeated = [event for event in before if time_of(event) >= kept_from_s]
    return frames + process_all(face, [*older, *repeated, *after])


def move_to_another_recognizer(lips: str, cut: int) -> list[Frame]:
    """Continue with another recognizer that repeats events that may not be final."""
    before = events()[:cut]
    face = make_face(lips)
    frames = process_all(face, before)
    final_s = max(map(final_until, before))
    repeated_events = [event for event in events() if middle_of(event) > final_s]
    first = min((event.index for event in repeated_events if isinstance(event, Phone)), default=0)
    face.change_recognizer()
    return frames + process_all(
        face,
        [
            replace(event, index=event.index - first) if isinstance(event, Phone) else event
            for event in repeated_events
        ],
    )


def final_until(event: SoundEvent) -> float:
    """Return the media time before which nothing is repeated after an event."""
    match event:
        case Phone(final=True):
            return event.end_s
        case SpeechChange():
            return event.time_s
    return 0.0


def middle_of(event: SoundEvent) -> float:
    return event.onset_s + event.duration_s / 2 if isinstance(event, Phone) else event.time_s


def values(frames: Sequence[Frame]) -> NDArray[np.float32]:
    return np.array([faps for _, faps in frames])


def steps(frames: Sequence[Frame]) -> NDArray[np.float32]:
    return np.abs(np.diff(values(frames), axis=0))


def assert_no_visible_step(frames: Sequence[Frame], lips: str) -> None:
    """Check that every media time occurs once, and that steps are not larger than before."""
    plain = uninterrupted(lips)
    assert [time_s for time_s, _ in frames] == [time_s for time_s, _ in plain]
    largest = steps(frames).max(axis=0) / np.maximum(steps(plain).max(axis=0), INVISIBLE_STEP)
    too_large = {fap + 1: float(largest[fap]) for fap in np.flatnonzero(largest > LARGEST_STEP)}
    assert not too_large


def gaps(frames: Sequence[Frame]) -> NDArray[np.float32]:
    faps = values(frames)
    gap: NDArray[np.float32] = -(faps[:, 4 - 1] + faps[:, 5 - 1])
    return gap


def assert_closed_in_time(frames: Sequence[Frame], lips: str) -> None:
    plain, moved = gaps(uninterrupted(lips)), gaps(frames)
    for number in np.flatnonzero(plain < CLOSED):
        assert moved[max(0, number - 1) : number + 2].min() < NEARLY_CLOSED


cuts = st.integers(0, 10_000).map(lambda number: number % (len(events()) - 60) + 40)
lip_models = st.sampled_from(["learned", "dynamic-visemes", "ferguson"])


MOVES = [move_to_another_synthesizer, move_to_another_recognizer]


@settings(max_examples=12)
@given(move=st.sampled_from(MOVES), lips=lip_models, cut=cuts)
def test_another_process_continues_anywhere(
    move: Callable[[str, int], list[Frame]], lips: str, cut: int
) -> None:
    frames = move(lips, cut)
    assert_no_visible_step(frames, lips)
    assert_closed_in_time(frames, lips)


def test_stress_before_a_move_causes_no_brow_movement_after_it() -> None:
    assert_no_visible_step(move_to_another_synthesizer("learned", 143), "learned")


@pytest.mark.parametrize("fap", [JAW, LOWER_LIP, EYELID, HEAD_PITCH])
@pytest.mark.parametrize("move", MOVES)
def test_continues_during_the_largest_movement(
    move: Callable[[str, int], list[Frame]], fap: int
) -> None:
    plain = uninterrupted("learned")
    shown_s = plain[int(steps(plain)[20:, fap - 1].argmax()) + 20][0]
    known_s = shown_s + lip_model_info("learned").delay_ms / 1e3
    cut = next(
        number
        for number, event in enumerate(events())
        if isinstance(event, Progress) and event.time_s > known_s + 0.001
    )
    frames = move("learned", cut)
    assert_no_visible_step(frames, "learned")
    assert_closed_in_time(frames, "learned")
