"""Load an acoustic model, whichever kind the file holds."""

from __future__ import annotations

from pathlib import Path

from services.recognizer import gmm, neural
from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.model_file import read_archive
from shared.errors import UserError

_FOLDER = Path(__file__).parent / "models"
MODEL_PATH = _FOLDER / "gmm.npz"


def load_model(path: Path = MODEL_PATH) -> AcousticModel:
    """Read a model file.

    Parameters
    ----------
    path
        A file that ``GmmModel.save`` or ``NeuralModel.save`` wrote.

    Raises
    ------
    UserError
        If the file is missing, broken or does not fit this program.
    """
    archive = read_archive(path)
    try:
        found = str(archive.array("format", ()))
        if found == gmm.FORMAT:
            return gmm.gmm_from(archive)
        if found == neural.FORMAT:
            return neural.neural_from(archive)
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train it again") from error
    raise UserError(
        f"acoustic model {path} has the format {found!r}; this program reads {gmm.FORMAT!r} and "
        f"{neural.FORMAT!r}: train it again"
    )
