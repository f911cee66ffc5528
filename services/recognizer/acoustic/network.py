"""Networks of acoustic models: ONNX files that onnxruntime runs on one thread."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Floats
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.onnx_session import open_network

MAX_POSITIONS = 1500  # rows of the table of positions
FRAMES_PER_POSITION = 2  # feature frames from one position to the next

_LONGEST_WAVE = 10_000.0  # of the sinusoids, over 2 pi


def position_table(width: int) -> Floats:
    """Return Whisper's table of sinusoidal positions, shape (1500, width)."""
    step = math.log(_LONGEST_WAVE) / (width // 2 - 1)
    phase = np.arange(MAX_POSITIONS)[:, None] * np.exp(-step * np.arange(width // 2))
    return np.concatenate([np.sin(phase), np.cos(phase)], axis=1).astype(np.float32)


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
