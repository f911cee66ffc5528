"""Recordings: everything is known before the first frame is made."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.full_model import synthesize
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.acoustic.load import load_live_model, load_model
from kouxing.services.recognizer.alignment import align_text
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.recording_chain import AnalyzedRecording, analyze_recording, animate_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"
STILL = SynthesizerConfig(idle_motion_seed=0, expressiveness=1.0)
TEXT = "爸爸妈妈跑步买苹果，伯伯陪婆婆慢慢品茶。"


@lru_cache
def bilabials(*, is_text_known: bool) -> AnalyzedRecording:
    samples, rate_hz = read_audio(DEMO / "bilabials-female.wav")
    model = load_model()
    aligned = align_text(model, samples, rate_hz, TEXT) if is_text_known else None
    return analyze_recording(model, samples[:, 0], lip_predictor_for(model), aligned)


def openings(heard: AnalyzedRecording) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times and the opening of the inner lips, learnt, FAP units."""
    frames = animate_recording(heard, load_lip_model(name="learnt"), STILL)
    return (
        np.array([time_s for time_s, _ in frames]),
        np.array([-faps[3] - faps[4] for _, faps in frames]),
    )


def test_dynamic_visemes_are_the_full_model() -> None:
    samples = read_audio(VOWELS_FILE)[0][:, 0]
    heard = analyze_recording(load_model(), samples)
    lips = load_lip_model(name="dynamic-visemes")
    assert isinstance(lips, DynamicVisemes)
    made = np.array([faps for _, faps in animate_recording(heard, lips, STILL)])
    num_frames = int(heard.duration_s * 50) + 1
    full = synthesize(lips, heard.phones, num_frames, 50.0, level_track(samples))
    assert np.ptp(full[:, 2]) > 100
    np.testing.assert_allclose(made[:num_frames], full, atol=1e-3)
    assert len(made) == num_frames + 15, "and the way to rest"


def test_of_a_known_text_every_closing_lip_shuts_and_vowels_are_open() -> None:
    heard = bilabials(is_text_known=True)
    times_s, opening = openings(heard)
    closing = [phone for phone in heard.phones if phone.symbol in ("b", "p", "m")]
    assert len(closing) == 16
    for phone in closing:
        assert opening[np.abs(times_s - phone.onset_s - 0.04) < 0.021].min() < 10, phone
    opens = [phone for phone in heard.phones if phone.symbol in ("a", "ai", "ao", "an", "ing")]
    for phone in opens:
        during = (times_s >= phone.onset_s) & (times_s < phone.onset_s + phone.duration_s)
        assert opening[during].max() > 100, phone


def test_recognised_phones_err_where_the_text_does_not() -> None:
    known, recognised = (bilabials(is_text_known=is_known) for is_known in (True, False))
    times_s, opening = openings(recognised)
    missed = [
        phone
        for phone in known.phones
        if phone.symbol in ("b", "p", "m")
        and opening[np.abs(times_s - phone.onset_s - 0.04) < 0.041].min() > 100
    ]
    assert missed


def test_lips_part_in_a_recognised_vowel_between_two_closures() -> None:
    samples = read_audio(DEMO / "bilabials-female.wav")[0][:, 0]
    model = load_live_model()
    heard = analyze_recording(model, samples, lip_predictor_for(model))
    times_s, opening = openings(heard)
    (vowel,) = [
        phone
        for before, phone, after in zip(
            heard.phones, heard.phones[1:], heard.phones[2:], strict=False
        )
        if (before.symbol, phone.symbol, after.symbol) == ("b", "o", "b")
    ]
    during = (times_s >= vowel.onset_s) & (times_s < vowel.onset_s + vowel.duration_s)
    assert opening[during].max() > 50


def test_every_phone_of_a_sentence_with_many_rounded_vowels_is_right() -> None:
    samples = read_audio(DEMO / "lake-male.wav")[0][:, 0]
    model = load_live_model()
    heard = analyze_recording(model, samples)
    spoken = [phone.symbol for phone in heard.phones if phone.symbol != model.inventory.silence]
    text = model.inventory.pronounce("五月的湖边，我和女儿读书、画鱼。")
    assert spoken == [phone for syllable in text for phone in syllable]


def test_the_face_knows_of_speech_when_it_is_due() -> None:
    speech = [
        SpeechChange(active=True, time_s=2.0),
        SpeechChange(active=False, time_s=4.0),
    ]
    heard = bilabials(is_text_known=False)
    quiet = [each for each in heard.events if not isinstance(each, Phone | SpeechChange)]
    config = SynthesizerConfig(lips="dynamic-visemes")
    lips = load_lip_model(name="dynamic-visemes")
    silent, spoken = (
        animate_recording(replace(heard, events=[*quiet, *changes]), lips, config)
        for changes in ([], speech)
    )
    moved = [s for (s, one), (_, other) in zip(silent, spoken, strict=True) if (one != other).any()]
    assert 1.95 < moved[0] < 2.2  # from the first loud syllable on
