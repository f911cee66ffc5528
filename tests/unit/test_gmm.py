from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from services.recognizer.acoustic_model import AcousticModel, Topology
from services.recognizer.combined import save_combined
from services.recognizer.features import NUM_FEATURES, NUM_STATIC, LogMel
from services.recognizer.gmm import FORMAT, GaussianMixtures, GmmModel, mixture_scores
from services.recognizer.load import MODEL_PATH, load_model
from services.recognizer.model_file import read_archive, write_archive
from services.recognizer.neural import NUM_INPUTS, NeuralModel
from shared.errors import UserError
from shared.phones import UNITS

pytestmark = pytest.mark.unit

NUM_STATES = 2 * len(UNITS)


def random_topology(rng: np.random.Generator) -> Topology:
    stay = rng.uniform(0.2, 0.8, NUM_STATES)
    return Topology(
        first_state=np.arange(len(UNITS) + 1) * 2,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        log_bigram=rng.normal(size=(len(UNITS), len(UNITS))).astype(np.float32),
        duration_mean_s=np.full(len(UNITS), 0.1, np.float32),
        duration_spread_s=np.full(len(UNITS), 0.1, np.float32),
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


def random_neural(seed: int = 0) -> NeuralModel:
    rng = np.random.default_rng(seed)
    widths = (3 * NUM_INPUTS, 16, NUM_STATES)
    return NeuralModel(
        topology=random_topology(rng),
        weights=tuple(
            rng.normal(0, 0.25, (a, b)).astype(np.float16).astype(np.float32)
            for a, b in pairwise(widths)
        ),
        biases=tuple(rng.normal(size=b).astype(np.float32) for b in widths[1:]),
        log_prior=np.log(rng.dirichlet(np.ones(NUM_STATES))).astype(np.float32),
        frame_offsets=np.array([-2, 0, 3]),
        prior_mean=rng.normal(10, 1, NUM_INPUTS).astype(np.float32),
        spread=np.full(NUM_INPUTS, 3.0, np.float32),
        kappa=0.5,
    )


def test_densities_are_the_textbook_s() -> None:
    """HTK book, eq. 7.2, against scipy's normal density."""
    rng = np.random.default_rng(0)
    mixtures = random_mixtures(rng)
    x = rng.normal(size=(5, NUM_FEATURES)).astype(np.float32)
    scale = np.sqrt(mixtures.covars)
    log_parts = np.sum(norm.logpdf(x[:, None, None, :], mixtures.means, scale), axis=-1)
    expected = logsumexp(log_parts + np.log(mixtures.weights), axis=-1)
    found = mixture_scores(x, mixtures.score_matrix(), 3)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_a_component_of_weight_zero_does_not_count() -> None:
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


@pytest.mark.parametrize("make", [random_gmm, random_neural])
def test_saved_and_loaded_scores_are_the_same(make: type, tmp_path: Path) -> None:
    model = make()
    model.save(tmp_path / "model.npz")
    loaded = load_model(tmp_path / "model.npz")
    noise = np.random.default_rng(0).normal(0, 0.1, 4000).astype(np.float32)
    log_mel = LogMel().accept_waveform(noise)
    first, second = model.stream(), loaded.stream()
    assert first.look_ahead_frames == second.look_ahead_frames
    expected = np.concatenate([first.accept(log_mel), first.finish()])
    found = np.concatenate([second.accept(log_mel), second.finish()])
    assert expected.shape == (len(log_mel), NUM_STATES)
    np.testing.assert_allclose(found, expected, rtol=2e-2, atol=2e-2)


@pytest.mark.parametrize("make", [random_gmm, random_neural])
def test_a_stream_scores_the_same_in_any_pieces_and_after_reset(make: type) -> None:
    noise = np.random.default_rng(0).normal(0, 0.1, 6000).astype(np.float32)
    log_mel = LogMel().accept_waveform(noise)
    stream = make().stream()
    whole = np.concatenate([stream.accept(log_mel), stream.finish()])
    stream.reset()
    pieces = [stream.accept(piece) for piece in np.split(log_mel, [0, 1, 3, 10, 11, 30])]
    np.testing.assert_array_equal(np.concatenate([*pieces, stream.finish()]), whole)
    assert len(stream.finish()) == 0


def combined_file(folder: Path, scales: tuple[float, float] = (0.5, 2.0)) -> Path:
    random_gmm().save(folder / "gmm.npz")
    random_neural().save(folder / "neural.npz")
    path = folder / "combined.npz"
    save_combined(path, random_gmm().topology, ["gmm.npz", "neural.npz"], scales)
    return path


def test_combined_scores_are_the_weighted_sum(tmp_path: Path) -> None:
    combined = load_model(combined_file(tmp_path))
    noise = np.random.default_rng(0).normal(0, 0.1, 6000).astype(np.float32)
    log_mel = LogMel().accept_waveform(noise)

    def scores(model: AcousticModel, pieces: list[np.ndarray]) -> np.ndarray:
        stream = model.stream()
        parts = [stream.accept(piece) for piece in pieces]
        return np.concatenate([*parts, stream.finish()])

    expected = 0.5 * scores(load_model(tmp_path / "gmm.npz"), [log_mel])
    expected += 2.0 * scores(load_model(tmp_path / "neural.npz"), [log_mel])
    whole = scores(combined, [log_mel])
    np.testing.assert_allclose(whole, expected, rtol=1e-4)
    np.testing.assert_array_equal(scores(combined, np.split(log_mel, [1, 2, 9, 30])), whole)
    stream = combined.stream()
    assert stream.look_ahead_frames == 4  # the slower part's
    first = stream.accept(log_mel)
    stream.reset()
    np.testing.assert_array_equal(stream.accept(log_mel), first)


def test_combined_files_are_checked(tmp_path: Path) -> None:
    path = combined_file(tmp_path)
    arrays = read_archive(path).arrays
    for names, message in (
        (["gmm.npz", "combined.npz"], "part of itself"),
        (["gmm.npz", "../neural.npz"], "plain file names"),
        (["gmm.npz", "none.npz"], "no acoustic model"),
        (["gmm.npz"], "scales has shape"),
    ):
        write_archive(path, {**arrays, "part_files": np.array(names)})
        with pytest.raises(UserError, match=message):
            load_model(path)
    other = {**arrays, "first_state": np.arange(len(UNITS) + 1)}
    short = {name: other[name][: len(UNITS)] for name in ("log_stay", "log_leave")}
    write_archive(path, {**other, **short})
    with pytest.raises(UserError, match="other states"):
        load_model(path)


def test_the_model_that_ships_loads_and_fits() -> None:
    model = load_model()
    topology = model.topology
    np.testing.assert_allclose(np.exp(topology.log_stay) + np.exp(topology.log_leave), 1, rtol=1e-4)
    assert (topology.duration_mean_s > 0.03).all()
    assert (topology.duration_mean_s < 0.6).all()
    assert MODEL_PATH.with_suffix(".md").is_file()  # its card


def test_broken_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    with pytest.raises(UserError, match="no acoustic model at"):
        load_model(path)
    path.write_bytes(b"not a model")
    with pytest.raises(UserError, match="is no acoustic model"):
        load_model(path)
    whole = MODEL_PATH.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="is no acoustic model"):
        load_model(path)
    np.savez(path, format=np.array([{"a": 1}], dtype=object))
    with pytest.raises(UserError, match="is no acoustic model"):
        load_model(path)
    np.save(tmp_path / "array.npz", np.zeros(3))
    (tmp_path / "array.npz.npy").rename(path)
    with pytest.raises(UserError, match="is no acoustic model"):
        load_model(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": np.array("gmm 99")}, "gmm 99"),
        ({"units": np.array(UNITS[::-1])}, "units"),
        ({"first_state": np.zeros(len(UNITS) + 1, np.int64)}, "not numbered upwards"),
        ({"means": np.zeros((3, 3, 3), np.float32)}, r"means has shape \(3, 3, 3\)"),
        ({"log_stay": np.full(NUM_STATES, np.nan, np.float32)}, "no numbers"),
        ({"covars": np.zeros((NUM_STATES, 3, NUM_FEATURES), np.float32)}, "negative"),
        ({"weights": np.zeros((NUM_STATES, 0), np.float32)}, "0 mixture components"),
        ({"half_width": np.array(9)}, "half width"),
    ],
)
def test_sizes_are_checked(change: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    random_gmm().save(path)
    write_archive(path, {**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame_offsets": np.array([3, 2, 1])}, "upwards"),
        ({"frame_offsets": np.array([1, 2, 3])}, "present frame"),
        ({"weights_1": np.zeros((15, NUM_STATES), np.float16)}, "weights_1 has shape"),
        ({"weights_1": np.zeros((16, 3)), "biases_1": np.zeros(3)}, "last layer"),
        ({"spread": np.zeros(NUM_INPUTS, np.float32)}, "spread"),
    ],
)
def test_sizes_of_networks_are_checked(
    change: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.npz"
    random_neural().save(path)
    write_archive(path, {**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


def test_a_missing_array_is_named(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    random_gmm().save(path)
    arrays = read_archive(path).arrays
    del arrays["rotation"]
    write_archive(path, arrays)
    with pytest.raises(UserError, match="rotation is missing"):
        load_model(path)


def test_format_name_is_in_the_file(tmp_path: Path) -> None:
    random_gmm().save(tmp_path / "model.npz")
    assert str(read_archive(tmp_path / "model.npz").arrays["format"]) == FORMAT
