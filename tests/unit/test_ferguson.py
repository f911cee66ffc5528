"""Ferguson lips: live, from a known text, and the training of their table."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.front_end.slices import measure_slices
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.ferguson.contour import opening_to_faps
from kouxing.services.synthesizer.lips.ferguson.key_frames import KeyFrames, build_key_frames
from kouxing.services.synthesizer.lips.ferguson.phone_table import load_table
from kouxing.services.synthesizer.lips.ferguson.syllable_segmenter import (
    SyllableSegmenter,
    segment_speech,
)
from kouxing.services.synthesizer.lips.ferguson.timing import MAX_SYLLABLES, time_text
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import load_inventory
from kouxing.training.ferguson.recipe import fit_openings, measure_travel, relative_openings
from tests.lips import clip_of, phone, utterance
from tests.live_streams import LiveStream
from tests.system import DEMO

LIPS = load_lip_model(name="ferguson")
INVENTORY = load_inventory()
TABLE = load_table(INVENTORY)
LOWER_LIP = 4  # column of FAP 5
WIDEST = float(opening_to_faps([5.0])[0, MOUTH_FAPS.index(5)])
DELAY_S = 0.16


def progress(start_s: float, end_s: float, *, loud: bool) -> list[SoundEvent]:
    return [
        Progress(time_s=round(number * 0.02, 2), level_db=-20.0 if loud else -70.0)
        for number in range(round(start_s / 0.02) + 1, round(end_s / 0.02) + 1)
    ]


def openings(events: Sequence[SoundEvent], face: FaceAnimator | None = None) -> NDArray[np.float64]:
    """Return R of the frames at 50 Hz."""
    face = face or FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S)
    frames = [faps for event in events for _, faps in face.process(event)]
    return 5.0 * np.array(frames, dtype=np.float64)[:, LOWER_LIP] / WIDEST


SENTENCE_EVENTS: list[SoundEvent] = [
    *progress(0.0, 0.5, loud=False),
    SpeechChange(active=True, time_s=0.5),
    *progress(0.5, 0.6, loud=True),
    phone(0, "m", 0.5, 0.1),
    *progress(0.6, 0.7, loud=True),
    phone(1, "a", 0.6, 0.4),
    *progress(0.7, 1.0, loud=True),
    *progress(1.0, 2.0, loud=False),
]


def test_openings_of_phones_and_rest_in_silence() -> None:
    live_openings = openings(SENTENCE_EVENTS)
    assert live_openings[:15].max() == 0.0
    assert live_openings[25] == pytest.approx(TABLE.opening["m"], abs=0.7)
    assert live_openings[31] == pytest.approx(TABLE.opening["a"], abs=0.7)
    assert np.argmax(live_openings) < 36
    assert live_openings[60:].max() < 0.05  # energy shows the end long before voice activity does


def test_no_jump_at_revisions_and_interruptions() -> None:
    phones = [event for event in SENTENCE_EVENTS if isinstance(event, Phone)]
    live_openings = openings([*SENTENCE_EVENTS[:-60], phones[0], replace(phones[1], symbol="u")])
    assert np.abs(np.diff(live_openings)).max() < 2.0
    face = FaceAnimator(LIPS, frame_rate_hz=50.0, delay_s=DELAY_S)
    before = openings(SENTENCE_EVENTS[:42], face)
    assert before[-1] > 2.0
    face.flush()
    after = openings(progress(0.74, 1.2, loud=False), face)
    assert np.abs(np.diff([before[-1], *after])).max() < 2.0
    assert after[8:].max() < 0.05


def test_lips_stay_within_their_travel() -> None:
    samples = to_16_khz(*read_audio(DEMO / "hello-female.wav"))[:32_000]
    settings = SynthesizerConfig(
        lips="ferguson", idle_motion=False, expressiveness=1.0, feeling=0.0
    )
    pipeline = LivePipeline(load_model(), LIPS, synthesizer=settings)
    frames = pipeline.accept_waveform(samples) + pipeline.input_finished()
    opening = 5.0 * np.array([faps for _, faps in frames])[:, LOWER_LIP] / WIDEST
    assert opening.min() >= 0.0
    assert 2.5 < opening.max() <= 5.0


RATE_HZ = 16_000


def speech(parts: Sequence[tuple[str, float]]) -> NDArray[np.float32]:
    """Return a sound of vowels (v), hissing consonants (s), weak nasals (n) and silence (-)."""
    rng = np.random.default_rng(0)
    sounds = []
    for kind, length_s in parts:
        time_s = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
        sine, noise = np.sin(2 * np.pi * 200.0 * time_s), rng.standard_normal(len(time_s))
        sound = {"v": 0.2 * sine, "s": 0.05 * noise, "n": 0.03 * sine, "-": 1e-4 * noise}
        sounds.append(sound[kind])
    return np.concatenate(sounds).astype(np.float32)


def test_segments_end_at_pauses_dips_and_hisses() -> None:
    parts = [("-", 0.4), ("v", 0.2), ("-", 0.2), ("v", 0.2), ("n", 0.08), ("v", 0.2)]
    segments = segment_speech(measure_slices(speech([*parts, ("s", 0.1), ("v", 0.2), ("-", 0.4)])))
    starts = [segment.start_s for segment in segments]
    np.testing.assert_allclose(starts, [0.4, 0.8, 1.0, 1.28], atol=0.045)
    assert segments[0].end_s == pytest.approx(0.6, abs=0.045)
    assert segments[1].end_s == segments[2].start_s
    assert segments[-1].end_s == pytest.approx(1.58, abs=0.045)


def test_streaming_finds_the_same_segments() -> None:
    samples = read_audio(DEMO / "hello-female.wav")[0].mean(axis=1)[: 2 * RATE_HZ]
    segmenter = SyllableSegmenter()
    segments = []
    for output in LiveStream(load_model()).feed(samples, chunk=113):
        if isinstance(output, Progress):
            segments += segmenter.add_slice(output)
    segments += segmenter.finish()
    assert segments == segment_speech(measure_slices(samples))
    assert len(segments) > 3


def test_finals_follow_by_the_influence_factor() -> None:
    sound = speech([("-", 0.4), ("n", 0.06), ("v", 0.2), ("s", 0.12), ("v", 0.2), ("-", 0.4)])
    phones = time_text(measure_slices(sound), [("m", "a"), ("s", "an")], TABLE)
    assert [phone.symbol for phone in phones] == ["m", "a", "s", "an"]
    m, a, s, an = phones
    assert m.onset_s == pytest.approx(0.4, abs=0.05)
    assert s.onset_s == pytest.approx(0.66, abs=0.05)
    length_s = an.end_s - s.onset_s
    assert an.onset_s == pytest.approx(s.onset_s + TABLE.influence["an"] * length_s)
    assert a.end_s == pytest.approx(s.onset_s)


def test_rejects_text_that_cannot_be_timed() -> None:
    silent = measure_slices(speech([("-", 1.0)]))
    with pytest.raises(UserError, match="no speech was found"):
        time_text(silent, [("a",)], TABLE)
    with pytest.raises(UserError, match="the text is empty"):
        time_text(silent, [], TABLE)
    with pytest.raises(UserError, match=f"the maximum is {MAX_SYLLABLES}"):
        time_text(silent, [("a",)] * (MAX_SYLLABLES + 1), TABLE)


def test_openings_between_key_frames_are_linear() -> None:
    frames = KeyFrames(np.array([0.0, 1.0, 2.0]), np.array([0.0, 4.0, 4.0]))
    np.testing.assert_allclose(frames.openings_at([-1.0, 0.25, 1.5, 9.0]), [0.0, 1.0, 4.0, 4.0])


def test_training_recovers_the_openings() -> None:
    phones = utterance(0, 200)
    time_s = np.arange(0.0, phones[-1].onset_s + 0.5, 0.04)
    true = dataclasses.replace(
        TABLE, opening={**TABLE.opening, "b": 0.0, "a": 5.0, "i": 1.5, "d": 2.5}
    )
    opening = build_key_frames(phones, true).openings_at(time_s)
    clip = clip_of(time_s, opening_to_faps(opening))
    relative = relative_openings([clip])[0]
    scale = 5.0 / np.percentile(opening, 98)  # the speaker's widest opening is 5
    np.testing.assert_allclose(relative, np.minimum(scale * opening, 5.0), atol=0.01)
    fitted = fit_openings([clip], [phones], INVENTORY)
    for symbol in ("a", "i", "u", "d", "b", "sh"):
        expected = min(scale * true.opening[symbol], 5.0)
        assert fitted[symbol] == pytest.approx(expected, abs=0.3)
    assert fitted["sil"] == fitted["b"] == 0.0
    # a phone without data follows its visemes
    assert fitted["ang"] == pytest.approx(fitted["a"], abs=0.3)
    travel = opening_to_faps([5.0])[0] / scale
    np.testing.assert_allclose(measure_travel([clip]), travel, rtol=0.05, atol=1e-9)
    assert len(measure_travel([clip])) == len(MOUTH_FAPS)
