"""Mouth profiles: their format, their effect, and how they are learned."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.mouth_profiles import learning
from kouxing.services.mouth_profiles.learning import (
    FilmedSpeech,
    Observations,
    fit_profile,
    measure_gain,
    observe,
)
from kouxing.services.mouth_profiles.lip_tracks import interpolate_track, lip_measures
from kouxing.services.recognizer.lips.lip_predictor import LIP_FAPS
from kouxing.services.recognizer.lips.mouth_profile import (
    MouthProfile,
    parse_mouth_profile,
    read_mouth_profile,
)
from kouxing.shared.errors import UserError
from tests.lip_predictors import random_lip_predictor
from tests.system import VOWELS_FILE, samples_of_file

MODEL = random_lip_predictor()
SHAPE = MODEL.residual_shape
NUM_FAPS = len(LIP_FAPS)
RNG = np.random.default_rng(0)
PROFILE = MouthProfile(
    scale=RNG.uniform(0.5, 1.5, NUM_FAPS).astype(np.float32),
    offset=RNG.normal(0, 30, NUM_FAPS).astype(np.float32),
    residual=RNG.normal(0, 20, SHAPE).astype(np.float32),
)
CONTENT = PROFILE.to_bytes(MODEL.digest)
VALUES_AT = 48


def test_parses_what_it_writes_at_16_bit_precision() -> None:
    parsed = parse_mouth_profile(CONTENT, MODEL.digest, SHAPE)
    for name in ("scale", "offset", "residual"):
        expected = getattr(PROFILE, name)
        np.testing.assert_allclose(getattr(parsed, name), expected, rtol=1e-3, atol=1e-4)


def with_value(index: int, value: float) -> bytes:
    at = VALUES_AT + 2 * index
    return CONTENT[:at] + np.array(value, "<f2").tobytes() + CONTENT[at + 2 :]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a mouth profile"),
        (b"PK\x03\x04" + CONTENT[4:], "not a mouth profile"),
        (CONTENT[:16] + bytes(32) + CONTENT[48:], "another lip model"),
        (CONTENT[:-2], "bytes instead of"),
        (with_value(0, np.nan), "out of bounds"),
        (with_value(NUM_FAPS, 3000.0), "out of bounds"),
        (with_value(2 * NUM_FAPS, -np.inf), "out of bounds"),
    ],
)
def test_rejects_invalid_profiles(content: bytes, message: str) -> None:
    with pytest.raises(UserError, match=message):
        MODEL.with_mouth_profile(content)


def test_reads_only_small_files_that_start_like_a_profile(tmp_path: Path) -> None:
    path = tmp_path / "me.mouth"
    with pytest.raises(UserError, match="no such file"):
        read_mouth_profile(path)
    for content, message in (
        (b"RIFF", "is not a mouth profile"),
        (bytes(70_000), "is not a mouth profile"),
    ):
        path.write_bytes(content)
        with pytest.raises(UserError, match=message):
            read_mouth_profile(path)
    path.write_bytes(CONTENT)
    assert read_mouth_profile(path) == CONTENT


def test_the_adapted_model_computes_the_formula() -> None:
    plain = MODEL.create_stream(MODEL.delays_s)
    adapted = MODEL.adapt(PROFILE).create_stream(MODEL.delays_s)
    for features in RNG.normal(size=(30, len(MODEL.feature_mean))).astype(np.float32):
        outputs, changed = plain.step(features), adapted.step(features)
        expected = PROFILE.scale * outputs[:, :NUM_FAPS] + PROFILE.offset
        expected += np.tensordot(plain.inner, PROFILE.residual, axes=1)
        np.testing.assert_allclose(changed[:, :NUM_FAPS], expected, rtol=1e-4, atol=1e-3)
        np.testing.assert_array_equal(changed[:, NUM_FAPS:], outputs[:, NUM_FAPS:])


def filmed_speech(num_positions: int) -> Observations:
    return Observations(
        known_s=0.02 * np.arange(num_positions, dtype=np.float64),
        predicted=RNG.normal(size=(num_positions, SHAPE[1], NUM_FAPS)).astype(np.float32),
        hidden=RNG.normal(size=(num_positions, SHAPE[0])).astype(np.float32),
        tracked=RNG.normal(size=(num_positions, SHAPE[1], NUM_FAPS)),
    )


def test_rejects_too_little_speech() -> None:
    with pytest.raises(UserError, match="s of speech show the lips"):
        fit_profile(filmed_speech(499))


def test_ten_seconds_of_speech_are_enough() -> None:
    speech = filmed_speech(500)
    fit_profile(speech)
    assert measure_gain(MODEL, speech).speech_s == 2.5


def test_only_speech_with_tracked_lips_counts() -> None:
    speech = filmed_speech(1000)
    speech.tracked[:400] = speech.tracked[600:700] = np.nan
    gain = measure_gain(MODEL, speech)
    assert gain.speech_s == 2.5
    assert len(gain.time_s) == 125
    speech.tracked[900:] = np.nan
    with pytest.raises(UserError, match="only 6 s of speech show the lips"):
        measure_gain(MODEL, speech)
    speech.tracked[:] = np.nan
    with pytest.raises(UserError, match="only 0 s of speech show the lips"):
        measure_gain(MODEL, speech)


@pytest.mark.parametrize(("interval_s", "hole_s"), [(0.04, 0.16), (0.2, 0.6)])
def test_interpolates_slow_images_but_not_holes(interval_s: float, hole_s: float) -> None:
    frame_s = np.arange(0, 10, interval_s)
    frame_s = frame_s[(frame_s <= 5) | (frame_s >= 5 + hole_s)]
    values = interpolate_track(frame_s, frame_s, np.array([2.5 * interval_s, 5 + hole_s / 2]))
    np.testing.assert_allclose(values, [2.5 * interval_s, np.nan])


def test_corrects_the_lag_of_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "MIN_SPEECH_S", 1.0)
    samples = samples_of_file(VOWELS_FILE)[:80_000]
    frame_s = np.arange(250) / 50
    still = FilmedSpeech(samples=samples, frame_s=frame_s, lip_track=np.zeros((250, NUM_FAPS)))
    plain = observe(MODEL, still)
    time_s = plain.known_s - MODEL.delays_s[-1]
    lips = np.stack(
        [np.interp(frame_s - 0.08, time_s, track) for track in plain.predicted[:, -1].T], axis=1
    )
    late = observe(MODEL, FilmedSpeech(samples=samples, frame_s=frame_s, lip_track=lips))
    assert opening_error(late) < 0.1 * opening_error(plain)


def opening_error(speech: Observations) -> float:
    tracked, predicted = (
        lip_measures(lips[:, -1])[:, 0] for lips in (speech.tracked, speech.predicted)
    )
    known: NDArray[np.bool_] = ~np.isnan(tracked)
    assert known.sum() > 50
    return float(((tracked - predicted)[known] ** 2).mean())
