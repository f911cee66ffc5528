"""A speaker's voice: its profile, what it changes, and learning it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer import voice_learning
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lip_tracks import measures_of
from kouxing.services.recognizer.lips import LIP_FAPS
from kouxing.services.recognizer.voice import Voice, parse_profile, read_profile
from kouxing.services.recognizer.voice_learning import (
    FilmedSpeech,
    Material,
    learn_voice,
    material_of,
    measure_gain,
    with_voice,
)
from kouxing.shared.errors import UserError
from tests.e2e.following import samples_of_file
from tests.lip_predictors import made_up_model
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit
MODEL = made_up_model()
NEURAL = load_model()
VOWELS = samples_of_file(VOWELS_FILE)[:80_000]
SHAPE = MODEL.residual_shape
DELAYS = SHAPE[1]
NUM_FAPS = len(LIP_FAPS)
RNG = np.random.default_rng(0)
VOICE = Voice(
    scale=RNG.uniform(0.5, 1.5, NUM_FAPS).astype(np.float32),
    offset=RNG.normal(0, 30, NUM_FAPS).astype(np.float32),
    residual=RNG.normal(0, 20, SHAPE).astype(np.float32),
)
PROFILE = VOICE.to_profile(MODEL.digest)
VALUES_AT = 48


def test_a_profile_is_read_back_as_far_as_16_bits_hold_it() -> None:
    voice = parse_profile(PROFILE, MODEL.digest, SHAPE)
    for name in ("scale", "offset", "residual"):
        np.testing.assert_allclose(getattr(voice, name), getattr(VOICE, name), rtol=1e-3, atol=1e-4)


def replaced(at: int, value: float) -> bytes:
    part = np.array(value, "<f2").tobytes()
    return PROFILE[: VALUES_AT + 2 * at] + part + PROFILE[VALUES_AT + 2 * at + 2 :]


@pytest.mark.parametrize(
    ("profile", "message"),
    [
        (b"", "no voice"),
        (b"PK\x03\x04" + PROFILE[4:], "no voice"),
        (PROFILE[:16] + bytes(32) + PROFILE[48:], "another model"),
        (PROFILE[:40], "another model"),
        (PROFILE[:-2], "cut off"),
        (PROFILE + b"\0\0", "cut off"),
        (replaced(0, np.nan), "out of bounds"),
        (replaced(0, -1.0), "out of bounds"),
        (replaced(NUM_FAPS, 3000.0), "out of bounds"),
        (replaced(2 * NUM_FAPS, -np.inf), "out of bounds"),
    ],
)
def test_a_bad_profile_is_refused(profile: bytes, message: str) -> None:
    with pytest.raises(UserError, match=message):
        MODEL.for_voice(profile)


def test_a_voice_never_leaves_its_bounds() -> None:
    wild = Voice(scale=VOICE.scale - 9, offset=VOICE.offset * 1e6, residual=VOICE.residual * 1e6)
    MODEL.for_voice(wild.to_profile(MODEL.digest))


def test_only_small_files_that_can_be_a_voice_are_read(tmp_path: Path) -> None:
    path = tmp_path / "me.voice"
    with pytest.raises(UserError, match="No such file"):
        read_profile(path)
    for content in (b"RIFF", PROFILE + bytes(65536)):
        path.write_bytes(content)
        with pytest.raises(UserError, match="is no voice"):
            read_profile(path)
    path.write_bytes(PROFILE)
    assert read_profile(path) == PROFILE


def test_the_model_with_a_voice_computes_what_the_formula_says() -> None:
    plain = MODEL.stream(MODEL.delays_s)
    spoken = MODEL.with_voice(VOICE).stream(MODEL.delays_s)
    for features in RNG.normal(size=(30, len(MODEL.feature_mean))).astype(np.float32):
        outputs, with_it = plain.step(features), spoken.step(features)
        expected = VOICE.scale * outputs[:, :NUM_FAPS] + VOICE.offset
        expected += np.tensordot(plain.inner, VOICE.residual, axes=1)
        np.testing.assert_allclose(with_it[:, :NUM_FAPS], expected, rtol=1e-4, atol=1e-3)
        np.testing.assert_array_equal(with_it[:, NUM_FAPS:], outputs[:, NUM_FAPS:])


def material(num_positions: int, voice: Voice, noise: float = 20.0, seed: int = 1) -> Material:
    """Speech of somebody with this voice."""
    rng = np.random.default_rng(seed)
    inner = rng.normal(size=(num_positions, SHAPE[0])).astype(np.float32)
    made = 100 * rng.normal(size=(num_positions, DELAYS, NUM_FAPS)).astype(np.float32)
    known_s: NDArray[np.float64] = 0.02 * np.arange(num_positions, dtype=np.float64)
    empty = np.zeros(made.shape)
    exact = with_voice(voice, Material(known_s=known_s, made=made, inner=inner, tracked=empty))
    tracked = exact + noise * rng.normal(size=made.shape)
    return Material(known_s=known_s, made=made, inner=inner, tracked=tracked)


def test_a_voice_is_learnt_from_enough_speech() -> None:
    learnt = learn_voice(material(4000, VOICE))
    np.testing.assert_allclose(learnt.scale, VOICE.scale, atol=0.1)
    np.testing.assert_allclose(learnt.offset, VOICE.offset, atol=3)
    np.testing.assert_allclose(learnt.residual, VOICE.residual, atol=5)


def test_where_there_is_no_residual_the_affine_map_alone_is_learnt() -> None:
    nothing = np.zeros(SHAPE, np.float32)
    affine = Voice(scale=VOICE.scale, offset=VOICE.offset, residual=nothing)
    learnt = learn_voice(material(600, affine, noise=200.0))
    assert np.abs(learnt.residual).max() < 10
    np.testing.assert_allclose(learnt.offset, VOICE.offset, atol=30)


def test_faps_that_no_camera_tracks_stay_as_the_model_makes_them() -> None:
    spoken = material(1000, VOICE)
    depth = LIP_FAPS.index(16)
    spoken.tracked[..., depth] = np.nan
    spoken.tracked[100:200] = np.nan
    learnt = learn_voice(spoken)
    assert (learnt.scale[depth], learnt.offset[depth]) == (1, 0)
    assert not learnt.residual[..., depth].any()
    assert learnt.scale[0] != 1


def test_the_gain_is_measured_on_what_was_not_learnt_from() -> None:
    gain = measure_gain(MODEL, material(2000, VOICE))
    assert gain.speech_s == 10.0
    assert gain.delay_s == 0.055
    assert (gain.after > gain.before + 0.02).all()
    assert gain.curves.shape == (3, 3, 500)
    tracked, before, after = gain.curves[0]
    assert np.abs(after - tracked).mean() < np.abs(before - tracked).mean()


@pytest.mark.parametrize("num_positions", [0, 499])
def test_too_little_speech_is_refused(num_positions: int) -> None:
    with pytest.raises(UserError, match="s of speech with lips in view"):
        learn_voice(material(num_positions, VOICE))


def test_a_camera_that_is_late_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voice_learning, "MIN_SPEECH_S", 1.0)
    still = FilmedSpeech(
        samples=VOWELS, frame_s=np.arange(250) / 50, lips=np.zeros((250, NUM_FAPS))
    )
    assert isinstance(NEURAL, NeuralModel)
    made = material_of(NEURAL, MODEL, still)
    time_s = made.known_s - MODEL.delays_s[-1]
    lips = np.stack(
        [np.interp(still.frame_s - 0.08, time_s, track) for track in made.made[:, -1].T], axis=1
    )
    late = FilmedSpeech(samples=VOWELS, frame_s=still.frame_s, lips=lips)
    found = material_of(NEURAL, MODEL, late)
    assert opening_error(found) < 0.1 * opening_error(made)


def opening_error(found: Material) -> float:
    tracked, made = (measures_of(each[:, -1])[:, 0] for each in (found.tracked, found.made))
    known: NDArray[np.bool_] = ~np.isnan(tracked)
    assert known.sum() > 50
    return float(((tracked - made)[known] ** 2).mean())
