"""Load an acoustic model, whichever kind the file holds."""

from __future__ import annotations

from pathlib import Path

from services.recognizer import combined, gmm, neural
from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.model_file import read_archive
from shared.errors import UserError

MODELS = Path(__file__).parent / "models"
SHIPPED = ("combined", "gmm", "neural")
DEFAULT_MODEL = "combined"
MODEL_PATH = MODELS / f"{DEFAULT_MODEL}.npz"


def model_path(name: str) -> Path:
    """Return the file of a shipped model's name; other names are files themselves."""
    return MODELS / f"{name}.npz" if name in SHIPPED else Path(name)


def load_model(path: Path = MODEL_PATH) -> AcousticModel:
    """Read a model file.

    Parameters
    ----------
    path
        A file that ``GmmModel.save``, ``NeuralModel.save`` or ``save_combined`` wrote.

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
        if found == combined.FORMAT:
            names = combined.part_files_of(archive)
            if path.name in names:
                raise ValueError("it is a part of itself")
            return combined.combined_from(
                archive, [load_model(path.with_name(name)) for name in names]
            )
    except ValueError as error:
        raise UserError(f"acoustic model {path}: {error}; train it again") from error
    known = ", ".join((gmm.FORMAT, neural.FORMAT, combined.FORMAT))
    raise UserError(
        f"acoustic model {path} has the format {found!r}; this program reads {known}: train again"
    )
