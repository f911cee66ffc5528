"""Figures drawn with matplotlib, an optional dependency of training and evaluation."""

from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError, install_command

_DOTS_PER_INCH = 80


def new_figure(width_in: float, height_in: float) -> Any:
    """Create an empty figure; raises ``UserError`` if matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 (optional)
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        raise UserError(f"pictures need matplotlib: {install_command('matplotlib')}") from None
    figure = Figure(figsize=(width_in, height_in), dpi=_DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format of the file's suffix; raises ``UserError`` if that fails."""
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot write the picture: {error}") from error
