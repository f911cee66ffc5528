"""Loads acoustic models of any kind."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

from kouxing.services.recognizer.acoustic import blocks, gmm, neural
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.model_file import Archive, read_archive
from kouxing.services.recognizer.acoustic.two_networks import TwoNetworks
from kouxing.shared.errors import UserError

MODELS = Path(__file__).parents[1] / "models"
SHIPPED = ("blocks", "gmm", "neural")
DEFAULT_MODEL = "blocks"
_ALONE = ("gmm", "neural")  # shipped models that run without another one
NEURAL_PATH = MODELS / "neural.npz"
_READERS: dict[str, Callable[[Archive], AcousticModel]] = {
    gmm.FORMAT: gmm.gmm_model_from,
    neural.FORMAT: neural.neural_model_from,
    blocks.FORMAT: blocks.block_model_from,
}


def model_path(name: str) -> Path:
    """Return the file of a shipped model, by its name; any other name is a path."""
    return MODELS / f"{name}.npz" if name in SHIPPED else Path(name)


def load_model(path: Path = NEURAL_PATH, *, look_ahead_ms: float | None = None) -> AcousticModel:
    """Read a model file, by default the shipped causal network.

    Parameters
    ----------
    path
        A file that a model's ``save`` wrote.
    look_ahead_ms
        A look-ahead that the neural model was trained for; None: the model's default. Other models
        ignore it.

    Raises ``UserError`` if the file is missing, broken or of another format, its language is not
    installed, or the neural model does not offer the look-ahead.
    """
    archive = read_archive(path)
    try:
        form = str(archive.array("format", ()))
        model = _READERS[form](archive)
    except KeyError:
        raise UserError(
            f"acoustic model {path} has the format {form!r}, but this version reads "
            f"{' and '.join(_READERS)}; train the model again"
        ) from None
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train the model again") from error
    except UserError as error:
        raise UserError(f"acoustic model {path}: {error}") from error
    if look_ahead_ms is not None and isinstance(model, neural.NeuralModel):
        return model.with_look_ahead(look_ahead_ms)
    return model


def load_live_model(
    name: str = DEFAULT_MODEL, *, look_ahead_ms: float | None = None
) -> AcousticModel:
    """Read a model by its name or path, as the recognizer runs it; raises as ``load_model``.

    A block model runs together with the shipped causal network.
    """
    if name in _ALONE:
        return load_model(model_path(name), look_ahead_ms=look_ahead_ms)
    with ThreadPoolExecutor(max_workers=1) as executor:  # both at the same time
        early = executor.submit(load_model, look_ahead_ms=look_ahead_ms)
        model = load_model(model_path(name), look_ahead_ms=look_ahead_ms)
        if not isinstance(model, blocks.BlockModel):
            return model
        return TwoNetworks(
            topology=model.topology, early=cast(neural.NeuralModel, early.result()), late=model
        )
