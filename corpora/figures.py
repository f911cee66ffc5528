"""Pictures drawn with matplotlib, which only training and evaluation need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError, install_command

_DOTS_PER_INCH = 80


def new_figure(width_in: float, height_in: float) -> Any:
    """Make an empty figure.

    Raises
    ------
    UserError
        If matplotlib is missing.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (optional)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        raise UserError(f"pictures need matplotlib: {install_command('matplotlib')}") from None
    figure = Figure(figsize=(width_in, height_in), dpi=_DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure; the suffix of its file names the format.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: the picture cannot be written: {error}") from error
