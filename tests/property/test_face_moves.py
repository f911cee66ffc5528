"""A face whose recognizer or synthesizer is replaced amid real speech, anywhere: nobody sees it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from kouxing.services.lip_models import lip_model_info
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange, Waveform
from tests.live_streams import recognize_live
from tests.system import DEMO

pytestmark = pytest.mark.property

KEPT_S = 3.0  # of events, that a new synthesizer is told again
LARGEST_STEP = 1.2  # times the largest one undisturbed
UNSEEN = 1.0  # FAP units; a smaller step is none
SHUT, NEARLY_SHUT = 12.0, 35.0  # FAP units between inner lips
RATE_HZ = 50.0
JAW, EYELID, HEAD_PITCH, LOWER_LIP = 3, 19, 48, 5  # FAPs


@lru_cache
def events() -> tuple[SoundEvent, ...]:
    """What a live recognizer tells of a sentence full of closures."""
    samples, _ = read_audio(DEMO / "bilabials-female.wav")
    model = load_live_model()
    outputs = recognize_live(model, samples, lips=lip_predictor_for(model), face_delay_s=0.06)
    return tuple(each for each in outputs if not isinstance(each, Waveform))


def make_face(lips: str) -> FaceAnimator:
    face = FaceAnimator(
        load_lip_model(name=lips),
        frame_rate_hz=RATE_HZ,
        delay_s=lip_model_info(lips).delay_ms / 1e3,
        idle_motion_seed=1,
        expressiveness=1.4,
    )
    face.set_expressions({"joy": 0.7}, hold_s=3600.0)
    return face


def tell(face: FaceAnimator, told: Sequence[SoundEvent]) -> list[Frame]:
    return [frame for event in told for frame in face.process(event)]


@lru_cache
def undisturbed(lips: str) -> list[Frame]:
    return tell(make_face(lips), events())


def time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s


def with_another_synthesizer(lips: str, cut: int) -> list[Frame]:
    """A new face is told what was shown last, then the last events, then what comes."""
    before, after = events()[:cut], events()[cut:]
    frames = tell(make_face(lips), before)
    kept_from_s = time_of(before[-1]) - KEPT_S
    changes = [each for each in before if isinstance(each, SpeechChange)]
    older = [each for each in changes if each.time_s < kept_from_s][-1:]
    face = make_face(lips)
    face.resume(frames[-1][0], len(frames), frames[-1][1])
    kept = [each for each in before if time_of(each) >= kept_from_s]
    return frames + tell(face, [*older, *kept, *after])


def with_another_recognizer(lips: str, cut: int) -> list[Frame]:
    """The face is told anew, with phones counted anew, what may not be final."""
    before = events()[:cut]
    face = make_face(lips)
    frames = tell(face, before)
    final_s = max(map(final_until, before))
    again = [each for each in events() if middle_of(each) > final_s]
    first = min((each.index for each in again if isinstance(each, Phone)), default=0)
    face.change_recognizer()
    return frames + tell(
        face,
        [
            replace(each, index=each.index - first) if isinstance(each, Phone) else each
            for each in again
        ],
    )


def final_until(event: SoundEvent) -> float:
    """Media time before which nothing is told again after an event."""
    match event:
        case Phone(final=True):
            return event.onset_s + event.duration_s
        case SpeechChange():
            return event.time_s
    return 0.0


def middle_of(event: SoundEvent) -> float:
    return event.onset_s + event.duration_s / 2 if isinstance(event, Phone) else event.time_s


def values(frames: Sequence[Frame]) -> NDArray[np.float32]:
    return np.array([faps for _, faps in frames])


def steps(frames: Sequence[Frame]) -> NDArray[np.float32]:
    return np.abs(np.diff(values(frames), axis=0))


def assert_unseen(frames: Sequence[Frame], lips: str) -> None:
    """Every media time comes once, and no FAP steps further than it does anyway."""
    plain = undisturbed(lips)
    assert [time_s for time_s, _ in frames] == [time_s for time_s, _ in plain]
    largest = steps(frames).max(axis=0) / np.maximum(steps(plain).max(axis=0), UNSEEN)
    too_large = {fap + 1: float(largest[fap]) for fap in np.flatnonzero(largest > LARGEST_STEP)}
    assert not too_large


def gaps(frames: Sequence[Frame]) -> NDArray[np.float32]:
    faps = values(frames)
    gap: NDArray[np.float32] = -(faps[:, 4 - 1] + faps[:, 5 - 1])
    return gap


def assert_shut_in_time(frames: Sequence[Frame], lips: str) -> None:
    plain, moved = gaps(undisturbed(lips)), gaps(frames)
    for number in np.flatnonzero(plain < SHUT):
        assert moved[max(0, number - 1) : number + 2].min() < NEARLY_SHUT


cuts = st.integers(0, 10_000).map(lambda number: number % (len(events()) - 60) + 40)
lip_models = st.sampled_from(["learnt", "dynamic-visemes", "ferguson"])
few_examples = settings(max_examples=8)


@few_examples
@given(lips=lip_models, cut=cuts)
def test_another_synthesizer_goes_on_anywhere(lips: str, cut: int) -> None:
    frames = with_another_synthesizer(lips, cut)
    assert_unseen(frames, lips)
    assert_shut_in_time(frames, lips)


@few_examples
@given(lips=lip_models, cut=cuts)
def test_another_recognizer_goes_on_anywhere(lips: str, cut: int) -> None:
    frames = with_another_recognizer(lips, cut)
    assert_unseen(frames, lips)
    assert_shut_in_time(frames, lips)


@pytest.mark.parametrize("fap", [JAW, LOWER_LIP, EYELID, HEAD_PITCH])
@pytest.mark.parametrize("move", [with_another_synthesizer, with_another_recognizer])
def test_a_face_goes_on_amid_its_largest_movement(
    move: Callable[[str, int], list[Frame]], fap: int
) -> None:
    plain = undisturbed("learnt")
    shown_s = plain[int(steps(plain)[20:, fap - 1].argmax()) + 20][0]
    known_s = shown_s + lip_model_info("learnt").delay_ms / 1e3
    cut = next(
        number
        for number, event in enumerate(events())
        if isinstance(event, Progress) and event.time_s > known_s + 0.001
    )
    frames = move("learnt", cut)
    assert_unseen(frames, "learnt")
    assert_shut_in_time(frames, "learnt")
