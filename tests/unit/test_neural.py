"""The neural model: its file, its look-aheads, sessions scored together."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic import neural as neural_module
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.acoustic.network import (
    MAX_POSITIONS,
    NUM_INPUTS,
    WINDOW,
    position_table,
)
from kouxing.services.recognizer.acoustic.neural import FORMAT, NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError

pytestmark = [pytest.mark.unit, pytest.mark.slow]

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
FRAMES = WhisperMel().accept_waveform(HELLO)


@cache
def neural(look_ahead_ms: float | None = None) -> NeuralModel:
    model = load_model(model_path("neural"), look_ahead_ms=look_ahead_ms)
    assert isinstance(model, NeuralModel)
    return model


def scores_of(model: AcousticModel, frames: np.ndarray) -> np.ndarray:
    stream = model.create_stream()
    return np.concatenate([stream.score(frames), stream.score(None)])


def test_look_aheads_have_different_scores() -> None:
    found = {}
    for frames in neural().look_aheads:
        model = neural(10.0 * frames)
        stream = model.create_stream()
        assert stream.look_ahead_frames == frames
        early = stream.score(FRAMES)
        num_early = len(early) - (len(FRAMES) - frames)
        assert num_early in (0, 1)  # a position scores two frames, the second as soon as the first
        found[int(frames)] = np.concatenate([early, stream.score(None)])
        assert found[int(frames)].shape == (len(FRAMES), model.topology.num_states)
    assert len({scores.tobytes() for scores in found.values()}) == len(found)


@pytest.mark.parametrize("num_frames", range(8))
def test_scores_all_frames_of_short_segments(num_frames: int) -> None:
    for frames in neural().look_aheads:
        stream = neural(10.0 * frames).create_stream()
        for _ in range(2):
            rows = [*stream.score(FRAMES[:num_frames]), *stream.score(None)]
            assert len(rows) == num_frames
        assert len(stream.score(None)) == 0


def test_scores_come_within_the_look_ahead() -> None:
    for frames in neural().look_aheads:
        stream = neural(10.0 * frames).create_stream()
        num_scores = 0
        for number in range(60):
            num_scores += len(stream.score(FRAMES[number : number + 1]))
            # Frame 0 with a look-ahead of one frame comes along with frame 1.
            assert num_scores >= number + 1 - frames or number < 2
            assert num_scores <= number + 2 - frames or num_scores == 0


def test_with_a_look_ahead_of_one_frame_frame_0_has_the_scores_of_frame_1() -> None:
    scores = scores_of(neural(10.0), FRAMES)
    np.testing.assert_array_equal(scores[0], scores[1])
    assert not np.array_equal(scores[1], scores[2])


def test_repeats_the_last_frame_at_the_end() -> None:
    for frames in (10.0, 60.0):
        model = neural(frames)
        longer = np.concatenate([FRAMES, np.repeat(FRAMES[-1:], 30, axis=0)])
        again = scores_of(model, longer)[: len(FRAMES)]
        np.testing.assert_array_equal(scores_of(model, FRAMES), again)


def test_scores_do_not_depend_on_frames_after_the_look_ahead() -> None:
    model = neural(30.0)
    other = FRAMES.copy()
    other[50:] += 0.5
    one, two = scores_of(model, FRAMES), scores_of(model, other)
    same = (one == two).all(axis=1)
    assert same[:47].all()
    assert not same[47:].any()


def test_scores_do_not_depend_on_frames_before_the_window() -> None:
    """What lies before the window of every layer and the frames around it changes nothing."""
    model = neural(10.0)
    layers = model.session.sizes.num_layers
    reach = 2 * layers * (WINDOW - 1) + 5
    frames = np.resize(FRAMES, (reach + 40, NUM_INPUTS))
    other = frames.copy()
    other[:4] += 0.5
    one, two = scores_of(model, frames), scores_of(model, other)
    assert not np.array_equal(one[reach - 60], two[reach - 60])
    np.testing.assert_array_equal(one[reach + 10 :], two[reach + 10 :])


def test_segments_are_independent() -> None:
    stream = neural().create_stream()
    first = np.concatenate([stream.score(FRAMES), stream.score(None)])
    assert len(stream.score(None)) == 0
    second = np.concatenate([stream.score(FRAMES), stream.score(None)])
    np.testing.assert_array_equal(second, first)
    stream.score(FRAMES[:77])
    stream.reset()
    again = np.concatenate([stream.score(FRAMES), stream.score(None)])
    np.testing.assert_array_equal(again, first)


def test_long_speech_restarts_the_table_with_an_empty_past(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = neural(10.0)
    whole = scores_of(model, FRAMES)
    monkeypatch.setattr(neural_module, "MAX_POSITIONS", 20)
    short = scores_of(model, FRAMES)
    assert short.shape == whole.shape
    np.testing.assert_array_equal(short[:41], whole[:41])
    assert not np.array_equal(short[41:43], whole[41:43])
    later = FRAMES.copy()
    later[:38] = 0.3  # what only the positions before the new beginning have seen
    np.testing.assert_array_equal(scores_of(model, later)[41:81], short[41:81])


def test_positions_are_sinusoids() -> None:
    table = position_table(512)
    assert table.shape == (MAX_POSITIONS, 512)
    np.testing.assert_array_equal(table[0], np.repeat([0, 1], 256))
    np.testing.assert_allclose(table[7, [0, 256]], [np.sin(7), np.cos(7)], rtol=1e-6)
    np.testing.assert_allclose(table[1000, 255], np.sin(0.1), rtol=1e-6)  # the longest wave


def test_saved_and_loaded_scores_are_the_same(tmp_path: Path) -> None:
    model = neural()
    model.save(tmp_path / "model.npz")
    again = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(scores_of(again, FRAMES), scores_of(model, FRAMES))


def test_rejects_an_unknown_look_ahead() -> None:
    with pytest.raises(UserError, match="no look-ahead of 50 ms; choose 10, 30"):
        neural(50.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": np.zeros(100, np.uint8)}, "network cannot be read"),
        ({"look_aheads": np.array([], np.int64)}, "has no look-aheads"),
        ({"look_aheads": np.array([1, 0])}, "look-aheads"),
        ({"look_aheads": np.array([1, 101])}, "look-aheads"),
        ({"look_aheads": np.arange(1, 50)}, "its network scores"),
        ({"output_layer": np.array(77)}, "output layer 77"),
        ({"log_prior": np.zeros(7, np.float32)}, "log_prior has shape"),
        ({"acoustic_scale": np.array(np.nan, np.float32)}, "not finite"),
    ],
)
def test_rejects_a_file_with_bad_arrays(
    change: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.npz"
    arrays = read_archive(model_path("neural")).arrays
    assert str(arrays["format"]) == FORMAT
    np.savez(path, allow_pickle=False, **{**arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


def with_network(change: Callable[[Any], None], path: Path) -> Path:
    """Write the shipped model with its network changed."""
    onnx = pytest.importorskip("onnx")
    arrays = read_archive(model_path("neural")).arrays
    network = onnx.load_model_from_string(arrays["network"].tobytes())
    change(network.graph)
    changed = np.frombuffer(network.SerializeToString(), np.uint8)
    np.savez(path, allow_pickle=False, **{**arrays, "network": changed})
    return path


def test_rejects_a_network_with_other_inputs(tmp_path: Path) -> None:
    def without_inputs(graph: Any) -> None:
        del graph.node[:], graph.output[1:], graph.input[:]
        graph.node.add(op_type="Identity", input=["norm.bias"], output=["log_posteriors"])

    def of_no_width(graph: Any) -> None:
        graph.input[1].type.tensor_type.shape.dim[1].dim_param = "any"

    def of_other_past(graph: Any) -> None:
        graph.input[3].type.tensor_type.shape.dim[3].dim_param = "any"

    def of_nan(graph: Any) -> None:
        (bias,) = (tensor for tensor in graph.initializer if tensor.name == "norm.bias")
        bias.raw_data = np.full(bias.dims[0], np.nan, np.float32).tobytes()

    for change, message in (
        (without_inputs, "has the inputs"),
        (of_no_width, "has the width any"),
        (of_other_past, "has past_mask of"),
        (of_nan, "are not finite"),
    ):
        with pytest.raises(UserError, match=message):
            load_model(with_network(change, tmp_path / "model.npz"))


def test_rejects_a_network_with_other_states(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    arrays = read_archive(model_path("neural")).arrays
    one_less = {name: arrays[name][:-1] for name in ("log_stay", "log_leave", "log_prior")}
    first_state = np.minimum(arrays["first_state"], len(arrays["log_prior"]) - 1)
    np.savez(path, allow_pickle=False, **{**arrays, **one_less, "first_state": first_state})
    with pytest.raises(UserError, match="its network scores"):
        load_model(path)
