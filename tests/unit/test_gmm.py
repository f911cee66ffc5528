from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from kouxing.services.recognizer.acoustic.gmm import (
    GaussianMixtures,
    GmmModel,
    mixture_scores,
)
from kouxing.services.recognizer.acoustic.load import NEURAL_PATH, load_model
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.front_end.features import NUM_BANDS, NUM_FEATURES, NUM_STATIC
from kouxing.services.recognizer.front_end.vtln import VocalTractNormalizer, without_pitch
from kouxing.shared.errors import UserError
from tests.languages import MANDARIN, NUM_PHONES, random_language, random_topology

pytestmark = pytest.mark.unit

NUM_STATES = 2 * NUM_PHONES


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
        topology=replace(
            random_topology(2, rng, random_language(rng)), lm_scale=1.5, phone_penalty=-0.25
        ),
        mixtures=random_mixtures(rng),
        rotation=np.eye(NUM_FEATURES, dtype=np.float32),
        prior_mean=np.zeros(NUM_STATIC, np.float32),
        half_width=2,
    )


def test_densities_match_scipy() -> None:
    rng = np.random.default_rng(0)
    mixtures = random_mixtures(rng)
    x = rng.normal(size=(5, NUM_FEATURES)).astype(np.float32)
    scale = np.sqrt(mixtures.covars)
    log_parts = np.sum(norm.logpdf(x[:, None, None, :], mixtures.means, scale), axis=-1)
    expected = logsumexp(log_parts + np.log(mixtures.weights), axis=-1)
    found = mixture_scores(x, mixtures.score_matrix(), 3)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def low_voice(num_samples: int) -> np.ndarray:
    """Return a voice of 100 Hz: pulses through a resonance."""
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
    np.testing.assert_array_equal(live.score(frames), model.create_stream().score(frames))


def test_rejects_broken_files(tmp_path: Path) -> None:
    path, pickled = tmp_path / "model.npz", tmp_path / "pickled.npz"
    with pytest.raises(UserError, match="no acoustic model at"):
        load_model(path)
    np.savez(pickled, format=np.array([{"a": 1}], dtype=object))
    whole = NEURAL_PATH.read_bytes()
    for content in (b"not a model", whole[: len(whole) // 2], pickled.read_bytes()):
        path.write_bytes(content)
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
