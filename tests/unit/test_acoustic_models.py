"""Acoustic models: each frame is scored once, in any chunks and segments; broken files."""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, score_segment
from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, GmmModel, mixture_scores
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.config import MODEL_NAMES
from kouxing.services.recognizer.front_end.features import NUM_FEATURES, NUM_STATIC
from kouxing.shared.errors import UserError
from kouxing.training.model_files import save_blocks, save_gmm
from tests.languages import MANDARIN, NUM_PHONES, random_topology
from tests.system import HELLO


@pytest.fixture(scope="module", params=MODEL_NAMES)
def model(request: pytest.FixtureRequest) -> AcousticModel:
    return load_model(request.param)


@pytest.fixture(scope="module")
def frames(model: AcousticModel) -> np.ndarray:
    return model.create_front_end().accept_waveform(HELLO)


@pytest.mark.parametrize("num_frames", [0, 1, 30])
def test_scores_every_frame_once(model: AcousticModel, frames: np.ndarray, num_frames: int) -> None:
    stream = model.create_stream()
    for _ in range(2):
        rows = [*stream.score(frames[:num_frames]), *stream.score(None)]
        assert len(rows) == num_frames
    assert len(stream.score(None)) == 0


def test_scores_come_within_the_look_ahead(model: AcousticModel, frames: np.ndarray) -> None:
    stream = model.create_stream()
    num_settled = 0
    for number in range(1, 60):
        num_settled += len(stream.score(frames[number - 1 : number]))
        assert num_settled >= number - stream.look_ahead_frames
        assert num_settled <= number


def test_chunks_and_earlier_segments_do_not_affect_scores(
    model: AcousticModel, frames: np.ndarray
) -> None:
    expected = score_segment(model, frames)
    stream = model.create_stream()
    stream.score(frames[:77])
    stream.reset()
    assert len(stream.provisional) == 0
    pieces = [stream.score(piece) for piece in np.split(frames, [0, 1, 3, 10, 11, 30])]
    np.testing.assert_array_equal(np.concatenate([*pieces, stream.score(None)]), expected)


@pytest.mark.parametrize("model", ["blocks", "gmm"], indirect=True)
def test_saved_and_loaded_scores_are_the_same(
    model: AcousticModel, frames: np.ndarray, tmp_path: Path
) -> None:
    save = save_gmm if isinstance(model, GmmModel) else save_blocks
    save(tmp_path / "model.npz", model)  # type: ignore[arg-type]
    again = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(score_segment(again, frames), score_segment(model, frames))
    for weight in ("lm_scale", "phone_penalty", "rate_weight"):
        assert getattr(again.topology, weight) == getattr(model.topology, weight)


NUM_STATES = 2 * NUM_PHONES


def random_mixtures(rng: np.random.Generator, num_mixtures: int = 3) -> GaussianMixtures:
    weights = rng.dirichlet(np.ones(num_mixtures), NUM_STATES)
    shape = (NUM_STATES, num_mixtures, NUM_FEATURES)
    return GaussianMixtures(
        weights=weights.astype(np.float32),
        means=rng.normal(size=shape).astype(np.float32),
        covars=rng.uniform(0.5, 2, shape).astype(np.float32),
    )


def random_gmm() -> GmmModel:
    rng = np.random.default_rng(0)
    return GmmModel(
        topology=random_topology(2, rng),
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
    scores = mixture_scores(x, mixtures.score_matrix(), 3)
    np.testing.assert_allclose(scores, expected, rtol=1e-4)


def test_rejects_broken_files(tmp_path: Path) -> None:
    path, pickled = tmp_path / "model.npz", tmp_path / "pickled.npz"
    with pytest.raises(UserError, match="no acoustic model at"):
        load_model(path)
    np.savez(pickled, format=np.array([{"a": 1}], dtype=object))
    model_bytes = model_path("gmm").read_bytes()
    for content in (b"not a model", model_bytes[: len(model_bytes) // 2], pickled.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(UserError, match="is not an acoustic model"):
            load_model(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": np.array("gmm 99")}, "gmm 99"),
        ({"phones": np.array(MANDARIN.phones[::-1])}, "its phones differ from"),
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
    save_gmm(path, random_gmm())
    np.savez(path, allow_pickle=False, **{**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)
