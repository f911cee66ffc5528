from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, GmmModel, mixture_scores
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.front_end.features import NUM_FEATURES, NUM_STATIC
from kouxing.shared.errors import UserError
from tests.languages import MANDARIN, NUM_PHONES, SIL, Table, random_topology

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
    hmms = random_topology(2, rng, Table.draw(rng, [0, 21, 30, SIL], order=3).tree())
    return GmmModel(
        topology=replace(hmms, lm_scale=1.5, phone_penalty=-0.25),
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


def test_rejects_broken_files(tmp_path: Path) -> None:
    path, pickled = tmp_path / "model.npz", tmp_path / "pickled.npz"
    with pytest.raises(UserError, match="no acoustic model at"):
        load_model(path)
    np.savez(pickled, format=np.array([{"a": 1}], dtype=object))
    whole = model_path("gmm").read_bytes()
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
        ({"covars": np.zeros((NUM_STATES, 3, NUM_FEATURES), np.float32)}, "negative"),
        ({"weights": np.zeros((NUM_STATES, 0), np.float32)}, "0 mixture components"),
    ],
)
def test_rejects_bad_arrays(change: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    random_gmm().save(path)
    np.savez(path, allow_pickle=False, **{**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)
