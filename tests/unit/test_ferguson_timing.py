"""Syllable endpoints, and phone times of a known text."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.synthesizer.lips.ferguson.endpoints import SyllableSegmenter, segment_speech
from kouxing.services.synthesizer.lips.ferguson.key_frames import KeyFrames
from kouxing.services.synthesizer.lips.ferguson.table import load_table
from kouxing.services.synthesizer.lips.ferguson.timing import MAX_SYLLABLES, time_text
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Progress
from kouxing.shared.phones.inventory import load_inventory
from tests.live_streams import LiveStream
from tests.system import DEMO

INVENTORY = load_inventory()
TABLE = load_table(INVENTORY)
RATE_HZ = 16_000


def speech(parts: Sequence[tuple[str, float]]) -> NDArray[np.float32]:
    """Return a sound of vowels (v), hissing consonants (s), weak nasals (n) and silence (-)."""
    rng = np.random.default_rng(0)
    made = []
    for kind, length_s in parts:
        time_s = np.arange(round(length_s * RATE_HZ)) / RATE_HZ
        sine, noise = np.sin(2 * np.pi * 200.0 * time_s), rng.standard_normal(len(time_s))
        made.append({"v": 0.2 * sine, "s": 0.05 * noise, "n": 0.03 * sine, "-": 1e-4 * noise}[kind])
    return np.concatenate(made).astype(np.float32)


def test_segments_end_at_pauses_dips_and_hisses() -> None:
    parts = [("-", 0.4), ("v", 0.2), ("-", 0.2), ("v", 0.2), ("n", 0.08), ("v", 0.2)]
    segments = segment_speech(progress_of(speech([*parts, ("s", 0.1), ("v", 0.2), ("-", 0.4)])))
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
    assert segments == segment_speech(progress_of(samples))
    assert len(segments) > 3


def test_finals_follow_by_the_influence_factor() -> None:
    sound = speech([("-", 0.4), ("n", 0.06), ("v", 0.2), ("s", 0.12), ("v", 0.2), ("-", 0.4)])
    phones = time_text(progress_of(sound), [("m", "a"), ("s", "an")], TABLE)
    assert [phone.symbol for phone in phones] == ["m", "a", "s", "an"]
    m, a, s, an = phones
    assert m.onset_s == pytest.approx(0.4, abs=0.05)
    assert s.onset_s == pytest.approx(0.66, abs=0.05)
    length_s = an.onset_s + an.duration_s - s.onset_s
    assert an.onset_s == pytest.approx(s.onset_s + TABLE.influence["an"] * length_s)
    assert a.onset_s + a.duration_s == pytest.approx(s.onset_s)


def test_rejects_text_that_cannot_be_timed() -> None:
    silent = progress_of(speech([("-", 1.0)]))
    with pytest.raises(UserError, match="no speech was found"):
        time_text(silent, [("a",)], TABLE)
    with pytest.raises(UserError, match="the text is empty"):
        time_text(silent, [], TABLE)
    with pytest.raises(UserError, match=f"at most {MAX_SYLLABLES}"):
        time_text(silent, [("a",)] * (MAX_SYLLABLES + 1), TABLE)


def test_key_frames_do_not_overshoot() -> None:
    frames = KeyFrames(np.array([0.0, 1.0, 2.0]), np.array([0.0, 4.0, 4.0]))
    np.testing.assert_allclose(frames.openings_at([-1.0, 0.25, 1.5, 9.0]), [0.0, 1.0, 4.0, 4.0])
    time_s = np.linspace(-1.0, 3.0, 401)
    smooth = frames.openings_at(time_s, smooth=True)
    assert smooth.max() <= 4.0
    assert (np.diff(smooth) >= -1e-12).all()
    np.testing.assert_allclose(frames.openings_at([0.0, 1.0, 2.0], smooth=True), [0.0, 4.0, 4.0])
