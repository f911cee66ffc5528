"""Load an acoustic model of any kind."""

from __future__ import annotations

from collections.abc import Callable
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
NEURAL_PATH = MODELS / "neural.npz"
_READERS: dict[str, Callable[[Archive], AcousticModel]] = {
    gmm.FORMAT: gmm.gmm_from,
    neural.FORMAT: neural.neural_from,
    blocks.FORMAT: blocks.blocks_from,
}


def model_path(name: str) -> Path:
    """Return the file of a shipped model, by its name; any other name is a path."""
    return MODELS / f"{name}.npz" if name in SHIPPED else Path(name)


def load_model(path: Path = NEURAL_PATH, *, look_ahead_ms: float | None = None) -> AcousticModel:
    """Read a model file.

    Parameters
    ----------
    path
        A file that the ``save`` of a model wrote; by default the shipped causal network.
    look_ahead_ms
        How far a neural model looks ahead, one of those it was trained for; None is the model's
        default. Other models have a fixed look-ahead and ignore this.

    Raises
    ------
    UserError
        If the file is missing, broken or of another format, its language is not installed, or the
        model was not trained for the look-ahead.
    """
    archive = read_archive(path)
    try:
        form = str(archive.array("format", ()))
        model = _READERS[form](archive)
    except KeyError:
        raise UserError(
            f"acoustic model {path} has the format {form!r}; this program reads "
            f"{' and '.join(_READERS)}: train again"
        ) from None
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train it again") from error
    except UserError as error:
        raise UserError(f"acoustic model {path}: {error}") from error
    if look_ahead_ms is not None and isinstance(model, neural.NeuralModel):
        return model.with_look_ahead(look_ahead_ms)
    return model


def load_live_model(
    name: str = DEFAULT_MODEL, *, look_ahead_ms: float | None = None
) -> AcousticModel:
    """Read a model, by its name or path, as the recognizer runs it.

    Raises
    ------
    UserError
        As :func:`load_model`.
    """
    model = load_model(model_path(name), look_ahead_ms=look_ahead_ms)
    return with_early_network(model, look_ahead_ms=look_ahead_ms)


def with_early_network(
    model: AcousticModel, *, look_ahead_ms: float | None = None
) -> AcousticModel:
    """Let the shipped causal network, with its look-ahead, run beside a block model.

    Raises
    ------
    UserError
        If it was not trained for the look-ahead.
    """
    if not isinstance(model, blocks.BlockModel):
        return model
    early = load_model(look_ahead_ms=look_ahead_ms)
    return TwoNetworks(cast(neural.NeuralModel, early), model)
