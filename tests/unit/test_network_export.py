"""The network's ONNX file: exported, read again, and run by onnxruntime."""

import numpy as np
import pytest
import torch

from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.network import NUM_INPUTS
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.training.neural.export import network_of, onnx_of
from kouxing.training.neural.network import Network, Shape

pytestmark = [pytest.mark.unit, pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

SHAPE = Shape(num_states=180, look_aheads=(2, 7), width=64, heads=4, layers=2, inner=80)


def some_network() -> Network:
    torch.manual_seed(0)
    network = Network(SHAPE).eval()
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return network


def log_posteriors_of(network: Network, frames: np.ndarray, output: int) -> np.ndarray:
    """A whole segment in PyTorch, (frames, states), from the first position's first frame."""
    with torch.no_grad():
        rows = network.log_posteriors(network(torch.from_numpy(frames)[None]), output)[0]
    flat: np.ndarray = rows.reshape(-1, SHAPE.num_states).numpy()
    return flat[max(0, SHAPE.look_aheads[output] - 2) :]


def scores_of(file: np.ndarray, frames: np.ndarray, output: int) -> np.ndarray:
    """The same live."""
    shipped = load_model(model_path("neural"))
    model = NeuralModel(
        topology=shipped.topology,
        network=file,
        look_aheads=np.array(SHAPE.look_aheads),
        log_prior=np.zeros(SHAPE.num_states, np.float32),
        acoustic_scale=1.0,
        output_layer=output,
    )
    return model.create_stream().score(frames)


@pytest.mark.parametrize("output", [0, 1])
@pytest.mark.parametrize(("exact", "atol"), [(True, 5e-4), (False, 0.1)])
def test_onnxruntime_computes_what_pytorch_does(output: int, exact: bool, atol: float) -> None:
    frames = np.random.default_rng(0).normal(0.3, 0.3, (301, NUM_INPUTS)).astype(np.float32)
    file = onnx_of(some_network(), exact=exact)
    expected = log_posteriors_of(network_of(file, SHAPE.look_aheads).eval(), frames, output)
    found = scores_of(file, frames, output)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, atol=atol)


def test_reads_floats_exactly() -> None:
    network = some_network()
    again = network_of(onnx_of(network, exact=True), SHAPE.look_aheads)
    assert again.shape == SHAPE
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], tensor, rtol=1e-6, atol=0)


def test_reads_integers_within_half_a_step() -> None:
    network = some_network()
    file = onnx_of(network)
    assert len(file) < 0.45 * len(onnx_of(network, exact=True))
    again = network_of(file, SHAPE.look_aheads).state_dict()
    for name, tensor in network.state_dict().items():
        if tensor.dim() > 1:
            rows = tensor.reshape(len(tensor), -1)
            step = rows.abs().amax(dim=1, keepdim=True) / 127
            error = (again[name].reshape(rows.shape) - rows).abs()
            assert (error <= 0.51 * step).all()
        else:
            torch.testing.assert_close(again[name], tensor, rtol=1e-6, atol=0)


def test_rejects_other_files() -> None:
    with pytest.raises(KeyError):
        network_of(np.zeros(0, np.uint8), SHAPE.look_aheads)
