"""Loads acoustic models of any kind."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from kouxing.services.recognizer.acoustic import blocks, gmm, light, universal
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.model_file import Archive, read_archive
from kouxing.services.recognizer.config import MODEL_NAMES
from kouxing.shared.arrays import UInt8
from kouxing.shared.errors import UserError

MODELS_FOLDER = Path(__file__).parents[1] / "models"
DEFAULT_MODEL = "blocks"
_READERS: dict[str, Callable[[Archive], AcousticModel]] = {
    gmm.FORMAT: gmm.parse_gmm_model,
    blocks.FORMAT: blocks.parse_block_model,
    universal.FORMAT: lambda archive: universal.parse_universal_model(archive, _block_network()),
}
_loaded: dict[str, AcousticModel] = {}  # shipped models


def model_path(name: str) -> Path:
    """Return the path of a shipped model; any other name is a path."""
    file = "blocks" if name == "light" else name
    return MODELS_FOLDER / f"{file}.npz" if name in MODEL_NAMES else Path(name)


def load_model(name: str | Path = DEFAULT_MODEL) -> AcousticModel:
    """Read a shipped model, by its name, or a file that a model's ``save`` wrote.

    Raises ``UserError`` if the file is missing, broken or of another format, or its language is not
    installed.
    """
    if known := _loaded.get(str(name)):
        return known
    path = model_path(str(name))
    archive = read_archive(path)
    try:
        stored_format = str(archive.array("format", ()))
        if stored_format not in _READERS:
            raise ValueError(f"its format is {stored_format!r}, not {' or '.join(_READERS)}")
        model = (
            light.parse_light_model(archive)
            if name == "light"
            else _READERS[stored_format](archive)
        )
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train the model again") from error
    except UserError as error:
        raise UserError(f"acoustic model {path}: {error}") from error
    if name in MODEL_NAMES:
        _loaded[str(name)] = model
    return model


def _block_network() -> UInt8:
    model = _loaded.get("blocks")
    if isinstance(model, blocks.BlockModel):
        return model.network
    return read_archive(model_path("blocks")).array("network", None).astype(np.uint8)
