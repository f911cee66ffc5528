"""The teacher: Whisper's encoder on whole recordings, and the readout of states."""

import numpy as np
import pytest
import torch
from scipy.special import erf, softmax

from kouxing.services.recognizer.acoustic.network import position_table
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.training.neural.network import Shape
from kouxing.training.neural.teacher import (
    WholeEncoder,
)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

SHAPE = Shape(num_states=6, look_aheads=(), width=32, heads=2, layers=4, inner=48)


def whole_encoder() -> WholeEncoder:
    torch.manual_seed(0)
    encoder = WholeEncoder(SHAPE).eval()
    with torch.no_grad():  # trained convolutions differ more than new ones
        encoder.first.weight *= 6
        encoder.second.weight *= 6
    return encoder


# --- the encoder


def test_the_encoder_computes_its_formulas() -> None:
    """The encoder against plain formulas, position by position and head by head."""
    encoder = whole_encoder()
    weights = {name: tensor.numpy() for name, tensor in encoder.state_dict().items()}
    bands = np.random.default_rng(0).normal(0, 0.5, (NUM_MELS, 12)).astype(np.float32)

    def convolved(rows: np.ndarray, name: str, step: int) -> np.ndarray:
        padded = np.pad(rows, ((1, 1), (0, 0)))
        weight, bias = weights[f"{name}.weight"], weights[f"{name}.bias"]
        return np.array([
            np.einsum("oik,ki->o", weight, padded[at : at + 3]) + bias
            for at in range(0, len(rows), step)
        ])  # fmt: skip

    def gelu(x: np.ndarray) -> np.ndarray:
        return np.asarray(x * (1 + erf(x / np.sqrt(2))) / 2)

    def product(x: np.ndarray, name: str) -> np.ndarray:
        return np.asarray(x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"])

    def normed(x: np.ndarray, name: str) -> np.ndarray:
        x = x - x.mean(axis=1, keepdims=True)
        x /= np.sqrt((x**2).mean(axis=1, keepdims=True) + 1e-5)
        return np.asarray(x * weights[f"{name}.weight"] + weights[f"{name}.bias"])

    hidden = gelu(convolved(gelu(convolved(bands.T, "first", 1)), "second", 2))
    hidden = hidden + position_table(32)[:6]
    after = []
    for layer in (f"layers.{number}" for number in range(4)):
        parts = product(normed(hidden, f"{layer}.attention_norm"), f"{layer}.query_key_value")
        query, key, value = parts.reshape(6, 3, 2, 16).transpose(1, 2, 0, 3)
        seen = [softmax(query[h] @ key[h].T / 4, axis=1) @ value[h] for h in range(2)]
        hidden = hidden + product(np.hstack(seen), f"{layer}.attended")
        inner = gelu(product(normed(hidden, f"{layer}.inner_norm"), f"{layer}.inner"))
        hidden = hidden + product(inner, f"{layer}.outer")
        after.append(hidden)
    with torch.no_grad():
        found = encoder(torch.from_numpy(bands)[None])[0].numpy()
    np.testing.assert_allclose(found, np.hstack(after[1:]), atol=1e-4)
