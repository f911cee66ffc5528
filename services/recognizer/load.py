"""Load an acoustic model, whichever kind the file holds."""

from __future__ import annotations

from pathlib import Path

from services.recognizer import gmm, neural
from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.model_file import read_archive
from shared.errors import UserError

MODELS = Path(__file__).parent / "models"
SHIPPED = ("gmm", "neural")
DEFAULT_MODEL = "neural"
MODEL_PATH = MODELS / f"{DEFAULT_MODEL}.npz"


def model_path(name: str) -> Path:
    """Return the file of a shipped model's name; other names are files themselves."""
    return MODELS / f"{name}.npz" if name in SHIPPED else Path(name)


def load_model(path: Path = MODEL_PATH, *, look_ahead_ms: float | None = None) -> AcousticModel:
    """Read a model file.

    Parameters
    ----------
    path
        A file that ``GmmModel.save`` or ``NeuralModel.save`` wrote.
    look_ahead_ms
        How far a neural model looks ahead, one of those it was trained for; None is its usual one.
        A Gaussian mixture model has one only, and this is left out of account.

    Raises
    ------
    UserError
        If the file is missing, broken or does not fit this program, or the model does not know the
        look-ahead.
    """
    archive = read_archive(path)
    try:
        found = str(archive.array("format", ()))
        if found == gmm.FORMAT:
            return gmm.gmm_from(archive)
        if found == neural.FORMAT:
            model = neural.neural_from(archive)
            return model if look_ahead_ms is None else model.with_look_ahead(look_ahead_ms)
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train it again") from error
    raise UserError(
        f"acoustic model {path} has the format {found!r}; this program reads {gmm.FORMAT} and "
        f"{neural.FORMAT}: train again"
    )
