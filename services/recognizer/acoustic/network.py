"""Networks of acoustic models: ONNX files that onnxruntime runs on one thread."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Floats
from kouxing.services.recognizer.acoustic.caches import CacheSizes, cache_names
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from kouxing.services.recognizer.onnx_session import open_network

NUM_INPUTS = NUM_MELS
WINDOW = 128  # positions that one attends to, including itself
MAX_POSITIONS = 1500  # rows of the table of positions
SEEN_FRAMES = 5  # feature frames that a position takes as input
FRAMES_PER_POSITION = 2  # feature frames from one position to the next

_OUTPUTS = ["log_posteriors", "keys", "values"]
_MIN_WIDTH, _MAX_WIDTH = 4, 4096
_MAX_LAYERS = 64
_LONGEST_WAVE = 10_000.0  # of the sinusoids, over 2 pi


@dataclass(frozen=True, slots=True)
class NetworkSizes:
    """Sizes of a network, read from its inputs."""

    width: int
    num_layers: int
    num_heads: int  # of attention
    head_size: int  # numbers in a head's key or value

    @property
    def cache(self) -> CacheSizes:
        """Sizes of a session's cache."""
        return CacheSizes(2 * self.num_layers, self.num_heads, WINDOW, self.head_size)


def position_table(width: int) -> Floats:
    """Return Whisper's table of sinusoidal positions, shape (1500, width)."""
    step = math.log(_LONGEST_WAVE) / (width // 2 - 1)
    phase = np.arange(MAX_POSITIONS)[:, None] * np.exp(-step * np.arange(width // 2))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)


def past_masks() -> Floats:
    """Return attention masks by the number of positions in a cache, shape (128, 1, 1, 128).

    A mask is added to the products with the cached keys. The last slot is for the position itself.
    """
    slot = np.arange(WINDOW)
    is_empty = (slot >= np.arange(WINDOW)[:, None]) & (slot < WINDOW - 1)
    return np.where(is_empty, np.float32(-np.inf), np.float32(0))[:, None, None]


def input_names(num_layers: int) -> list[str]:
    """Return the names of the network's inputs, in order."""
    return ["frames", "position", "output_layer", "past_mask", *cache_names(num_layers)]


@dataclass(frozen=True, kw_only=True)
class NetworkModel(AcousticModel):
    """A model whose scores come from the log posteriors of a network."""

    network: NDArray[np.uint8]  # an ONNX file
    log_prior: Floats  # (states,)
    acoustic_scale: float

    def create_front_end(self) -> WhisperMel:
        """Create the front end of one session."""
        return WhisperMel()

    def scores_of(self, log_posteriors: Floats) -> Floats:
        """Divide posteriors by priors (Bourlard and Morgan 1994), and weight the log scores."""
        scores: Floats = np.float32(self.acoustic_scale) * (log_posteriors - self.log_prior)
        return scores


def open_session(file: NDArray[np.uint8]) -> Any:
    """Open a model's ONNX file, given as bytes; ValueError if it is not an ONNX file."""
    try:
        return open_network(file.tobytes())
    except Exception as error:  # onnxruntime's errors have no common base
        raise ValueError(f"its network cannot be read ({error})") from error


def run_session(session: Any, outputs: list[str], inputs: Mapping[str, NDArray[Any]]) -> Any:
    """Return a network's outputs; ValueError if it does not run."""
    try:
        return session.run(outputs, inputs)
    except Exception as error:
        raise ValueError(f"its network does not run ({error})") from error


def check_outputs(outputs: Sequence[NDArray[Any]], shapes: Sequence[tuple[int, ...]]) -> None:
    """Raise ``ValueError`` if a network's outputs do not have these shapes or are not finite."""
    if [array.shape for array in outputs] != list(shapes):
        raise ValueError(f"its network scores {outputs[0].shape}, expected {shapes[0]}")
    if not all(np.isfinite(array).all() for array in outputs):
        raise ValueError("its network scores with values that are not finite")


class NetworkRunner:
    """The neural model's network, ready to run; ``ValueError`` if the file has another kind."""

    def __init__(self, file: NDArray[np.uint8]) -> None:
        self._session = open_session(file)
        self.sizes = _sizes_of({node.name: node.shape for node in self._session.get_inputs()})

    def run(self, inputs: Mapping[str, NDArray[Any]]) -> list[Floats]:
        """Return log posteriors, keys and values; ``ValueError`` if the network does not run."""
        outputs: list[Floats] = run_session(self._session, _OUTPUTS, inputs)
        return outputs


def _sizes_of(shapes: Mapping[str, Sequence[object]]) -> NetworkSizes:
    """Read a network's sizes from its inputs; a run checks the other shapes."""
    num_layers = sum(name.startswith("keys_") for name in shapes)
    if not 1 <= num_layers <= _MAX_LAYERS or list(shapes) != input_names(num_layers):
        raise ValueError(f"its network has the inputs {', '.join(shapes)}")
    width, heads, size = shapes["position"][-1], shapes["keys_0"][1], shapes["keys_0"][-1]
    if (
        not (isinstance(width, int) and isinstance(heads, int) and isinstance(size, int))
        or not (_MIN_WIDTH <= width <= _MAX_WIDTH and width % 2 == 0)
        or not (heads >= 1 and size >= 1 and heads * size <= _MAX_WIDTH)
    ):
        raise ValueError(f"its network has the width {width}, {heads} heads of size {size}")
    return NetworkSizes(width, num_layers, heads, size)
