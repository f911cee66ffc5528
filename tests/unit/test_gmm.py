from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from kouxing.services.recognizer.acoustic.acoustic_model import NUM_POSITIONS, Topology
from kouxing.services.recognizer.acoustic.gmm import (
    FORMAT,
    GaussianMixtures,
    GmmModel,
    mixture_scores,
)
from kouxing.services.recognizer.acoustic.load import NEURAL_PATH, load_model
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.front_end.features import NUM_BANDS, NUM_FEATURES, NUM_STATIC
from kouxing.services.recognizer.front_end.vtln import VocalTractNormalizer, without_pitch
from kouxing.shared.errors import UserError
from tests.languages import MANDARIN, NUM_PHONES, random_language

pytestmark = pytest.mark.unit

NUM_STATES = 2 * NUM_PHONES


def random_topology(rng: np.random.Generator) -> Topology:
    stay = rng.uniform(0.2, 0.8, NUM_STATES)
    return Topology(
        first_state=np.arange(NUM_PHONES + 1) * 2,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        phone_lm=random_language(rng),
        lm_scale=1.5,
        phone_penalty=-0.25,
        duration_mean_s=np.full((NUM_POSITIONS, NUM_PHONES), 0.1, np.float32),
        duration_spread_s=np.full((NUM_POSITIONS, NUM_PHONES), 0.1, np.float32),
    )


def random_mixtures(rng: np.random.Generator, num_mixtures: int = 3) -> GaussianMixtures:
    weights = rng.dirichlet(np.ones(num_mixtures), NUM_STATES)
    shape = (NUM_STATES, num_mixtures, NUM_FEATURES)
    return GaussianMixtures(
        weights=weights.astype(np.float32),
        means=rng.normal(size=shape).astype(np.float32),
        covars=rng.uniform(0.5, 2, shape).astype(np.float32),
    )


def random_gmm(seed: int = 0) -> GmmModel:
    rng = np.random.default_rng(seed)
    return GmmModel(
        topology=random_topology(rng),
        mixtures=random_mixtures(rng),
        rotation=np.eye(NUM_FEATURES, dtype=np.float32),
        prior_mean=np.zeros(NUM_STATIC, np.float32),
        half_width=2,
    )


def test_densities_match_scipy() -> None:
    """HTK book, eq. 7.2, against scipy's normal density."""
    rng = np.random.default_rng(0)
    mixtures = random_mixtures(rng)
    x = rng.normal(size=(5, NUM_FEATURES)).astype(np.float32)
    scale = np.sqrt(mixtures.covars)
    log_parts = np.sum(norm.logpdf(x[:, None, None, :], mixtures.means, scale), axis=-1)
    expected = logsumexp(log_parts + np.log(mixtures.weights), axis=-1)
    found = mixture_scores(x, mixtures.score_matrix(), 3)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_ignores_components_with_weight_zero() -> None:
    mixtures = random_mixtures(np.random.default_rng(0), 2)
    alone = GaussianMixtures(
        weights=np.ones((NUM_STATES, 1), np.float32),
        means=mixtures.means[:, :1],
        covars=mixtures.covars[:, :1],
    )
    mixtures.weights[:] = [1.0, 0.0]
    x = np.zeros((1, NUM_FEATURES), np.float32)
    both = mixture_scores(x, mixtures.score_matrix(), 2)
    np.testing.assert_allclose(both, mixture_scores(x, alone.score_matrix(), 1), rtol=1e-5)


def test_saved_and_loaded_scores_are_the_same(tmp_path: Path) -> None:
    model = random_gmm()
    model.save(tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    noise = np.random.default_rng(0).normal(0, 0.1, 4000).astype(np.float32)
    frames = model.create_front_end().accept_waveform(noise)
    first, second = model.create_stream(), loaded.create_stream()
    assert first.look_ahead_frames == second.look_ahead_frames
    expected = np.concatenate([first.score(frames), first.score(None)])
    found = np.concatenate([second.score(frames), second.score(None)])
    assert expected.shape == (len(frames), NUM_STATES)
    np.testing.assert_allclose(found, expected, rtol=2e-2, atol=2e-2)
    again = loaded.topology
    assert (again.lm_scale, again.phone_penalty) == (1.5, -0.25)
    np.testing.assert_array_equal(again.phone_lm.phone, model.topology.phone_lm.phone)


def test_chunks_and_resets_do_not_affect_scores() -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 6000).astype(np.float32)
    model = random_gmm()
    frames = model.create_front_end().accept_waveform(noise)
    stream = model.create_stream()
    whole = np.concatenate([stream.score(frames), stream.score(None)])
    stream.reset()
    pieces = [stream.score(piece) for piece in np.split(frames, [0, 1, 3, 10, 11, 30])]
    np.testing.assert_array_equal(np.concatenate([*pieces, stream.score(None)]), whole)
    assert len(stream.score(None)) == 0


def low_voice(num_samples: int) -> np.ndarray:
    """A voice of 100 Hz: a pulse and what rings after it, again and again."""
    pulses = np.zeros(num_samples)
    pulses[::160] = 1.0
    ringing = np.sin(2 * np.pi * 700 * np.arange(320) / 16_000) * np.exp(-np.arange(320) / 60)
    voice: np.ndarray = 0.3 * np.convolve(pulses, ringing)[:num_samples]
    return voice.astype(np.float32)


def test_normalizes_low_voices_and_keeps_their_pitch_across_segments() -> None:
    model = random_gmm()
    frames = model.create_front_end().accept_waveform(low_voice(16_000))
    assert frames.shape[1] == 1 + NUM_BANDS + 2
    vtln = VocalTractNormalizer()
    live, given = model.create_stream(), model.create_stream()
    for segment in (frames[:60], frames[60:]):
        warped = vtln.warp(segment[:, :-2], segment[:, -2], segment[:, -1])
        assert not np.array_equal(warped[-1], segment[-1, :-2])
        found = np.concatenate([live.score(segment), live.score(None)])
        expected = np.concatenate([given.score(without_pitch(warped)), given.score(None)])
        np.testing.assert_array_equal(found, expected)
    live.reset()
    anew = model.create_stream()
    np.testing.assert_array_equal(live.score(frames), anew.score(frames))


def test_rejects_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    with pytest.raises(UserError, match="no acoustic model at"):
        load_model(path)
    path.write_bytes(b"not a model")
    with pytest.raises(UserError, match="is not an acoustic model"):
        load_model(path)
    whole = NEURAL_PATH.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="is not an acoustic model"):
        load_model(path)
    np.savez(path, format=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UserError, match="is not an acoustic model"):
        load_model(path)
    np.save(tmp_path / "array.npz", np.zeros(3))
    (tmp_path / "array.npz.npy").rename(path)
    with pytest.raises(UserError, match="is not an acoustic model"):
        load_model(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": np.array("gmm 99")}, "gmm 99"),
        ({"phones": np.array(MANDARIN.phones[::-1])}, "phones are not those"),
        ({"language": np.array("klingon")}, "language 'klingon' is not installed"),
        ({"first_state": np.zeros(NUM_PHONES + 1, np.int64)}, "not in order"),
        ({"means": np.zeros((3, 3, 3), np.float32)}, r"means has shape \(3, 3, 3\)"),
        ({"log_stay": np.full(NUM_STATES, np.nan, np.float32)}, "not finite"),
        ({"lm_children": np.zeros(99, np.uint8)}, "its phone language model is not a tree"),
        ({"lm_phone": np.zeros(3, np.uint8)}, r"lm_phone has shape \(3,\)"),
        ({"lm_scale": np.array(np.inf)}, "lm_scale contains values that are not finite"),
        ({"phone_penalty": np.zeros(2)}, r"phone_penalty has shape \(2,\)"),
        ({"covars": np.zeros((NUM_STATES, 3, NUM_FEATURES), np.float32)}, "negative"),
        ({"weights": np.zeros((NUM_STATES, 0), np.float32)}, "0 mixture components"),
        ({"half_width": np.array(9)}, "half width"),
    ],
)
def test_rejects_bad_arrays(change: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    random_gmm().save(path)
    np.savez(path, allow_pickle=False, **{**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


def test_rejects_a_file_without_an_array(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    random_gmm().save(path)
    arrays = read_archive(path).arrays
    del arrays["rotation"]
    np.savez(path, allow_pickle=False, **arrays)
    with pytest.raises(UserError, match="rotation is missing"):
        load_model(path)


def test_format_name_is_in_the_file(tmp_path: Path) -> None:
    random_gmm().save(tmp_path / "model.npz")
    assert str(read_archive(tmp_path / "model.npz").arrays["format"]) == FORMAT
