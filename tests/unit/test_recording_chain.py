"""Recordings: everything is known before the first frame is made."""

import numpy as np

from kouxing.evaluation.lips.offline_visemes import synthesize
from kouxing.services.mouth_profiles.lip_tracks import measure_levels
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.offline.alignment import align_text
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.recording_pipeline import analyze_recording, animate_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.load import load_lip_model
from tests.system import DEMO, VOWELS_FILE, samples_of_file

STILL = SynthesizerConfig(idle_motion=False, expressiveness=1.0, feeling=0.0)


def test_dynamic_visemes_are_the_full_model() -> None:
    samples = samples_of_file(VOWELS_FILE)
    analyzed = analyze_recording(
        samples, recognize_recording(load_model(), samples), is_text_known=False
    )
    lips = load_lip_model(name="dynamic-visemes")
    assert isinstance(lips, DynamicVisemes)
    frames = np.array([faps for _, faps in animate_recording(analyzed, lips, STILL)])
    num_frames = int(analyzed.duration_s * 50) + 1
    full = synthesize(lips, analyzed.phones, num_frames, 50.0, measure_levels(samples))
    assert np.ptp(full[:, 2]) > 100
    np.testing.assert_allclose(frames[:num_frames], full, atol=1e-3)
    assert len(frames) == num_frames + 15, "and the way to rest"


def test_lips_close_and_open_for_the_phones_of_a_known_text() -> None:
    samples = samples_of_file(DEMO / "bilabials-female.wav")
    model = load_model()
    aligned = align_text(model, samples, "爸爸妈妈跑步买苹果，伯伯陪婆婆慢慢品茶。")
    analyzed = analyze_recording(samples, aligned, load_lip_predictor())
    frames = animate_recording(analyzed, load_lip_model(name="learned"), STILL)
    times_s = np.array([time_s for time_s, _ in frames])
    opening = np.array([-faps[3] - faps[4] for _, faps in frames])  # of the inner lips
    closing = [phone for phone in analyzed.phones if phone.symbol in ("b", "p", "m")]
    assert len(closing) == 16
    for phone in closing:
        assert opening[np.abs(times_s - phone.onset_s - 0.04) < 0.021].min() < 10, phone
    for phone in analyzed.phones:
        if phone.symbol in ("a", "ai", "ao", "an", "ing"):
            during = (times_s >= phone.onset_s) & (times_s < phone.end_s)
            assert opening[during].max() > 100, phone


def test_every_phone_of_a_sentence_with_many_rounded_vowels_is_right() -> None:
    samples = samples_of_file(DEMO / "lake-male.wav")
    model = load_model()
    phones = recognize_recording(model, samples)
    spoken = [phone.symbol for phone in phones if phone.symbol != model.inventory.silence]
    text = model.inventory.pronounce("五月的湖边，我和女儿读书、画鱼。")
    assert spoken == [phone for syllable in text for phone in syllable]
