"""Exporters of a face's curves: FAPs or blend shapes of every frame.

To add a format, write a subclass of ``CurveExporter`` and add its suffix to ``CURVE_EXPORTERS``.
``kouxing render`` and ``kouxing listen`` then write it.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from kouxing.services.cli.options import CurveForm, ExportOptions
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, write_fap
from kouxing.shared.face.faps import FAPS, NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.terminal import cannot_write

if TYPE_CHECKING:
    from kouxing.services.cli.animation import Motion

Values = NDArray[np.float32]
Row = tuple[float, int, Values]  # media time in seconds, frame number, FAPs (68,)


class CurveExporter(ABC):
    """Writes the curves of a face to a file.

    Of the options, only ``form``, ``head`` and ``lips`` are used. Raises ``UserError`` if they do
    not fit the format, or the folder does not exist.
    """

    unit: ClassVar[str] = "frame"
    forms: ClassVar[tuple[CurveForm, ...]] = tuple(CurveForm)

    def __init__(self, output: Path, options: ExportOptions) -> None:
        if options.form not in self.forms:
            raise UserError(
                f"{output}: this format holds {' or '.join(self.forms)}; for {options.form}, write"
                " .csv or .jsonl"
            )
        if len(options.lips) > 1:
            raise UserError("a curve file holds one face; give --lips only once")
        if not output.parent.is_dir():
            raise cannot_write(output, FileNotFoundError())
        self._output = output
        self._form = options.form
        self._head = options.head

    def export(self, motion: Motion, progress: Progress) -> int:
        """Write all frames of a motion and return their number."""
        rows = ((time_s, number, faps) for number, (time_s, faps) in enumerate(motion.frames))
        return self.write(rows, motion.frame_rate_hz)

    @abstractmethod
    def write(self, rows: Iterable[Row], frame_rate_hz: float | None = None) -> int:
        """Write frames as they arrive and return their number.

        If ``frame_rate_hz`` is None, it is estimated from the times of the frames. Raises
        ``UserError`` if the file cannot be written.
        """


class CsvExporter(CurveExporter):
    """Writes comma-separated values, with a column for each FAP or shape."""

    def write(self, rows: Iterable[Row], frame_rate_hz: float | None = None) -> int:
        """Write each frame when it arrives."""
        columns = ",".join(["time_s", *_value_names(self._form)])
        lines = (
            ",".join([f"{time_s:.3f}", *(f"{value:.4g}" for value in _values(faps, self._form))])
            for time_s, _, faps in rows
        )
        return _write_lines(self._output, chain([columns], lines)) - 1


class JsonLinesExporter(CurveExporter):
    """Writes a JSON object for each frame."""

    def write(self, rows: Iterable[Row], frame_rate_hz: float | None = None) -> int:
        """Write each frame when it arrives."""
        return _write_lines(self._output, (json_line(row, self._form) for row in rows))


class FapExporter(CurveExporter):
    """Writes an MPEG-4 ``.fap`` file."""

    forms = (CurveForm.FAPS,)

    def write(self, rows: Iterable[Row], frame_rate_hz: float | None = None) -> int:
        """Write the frames when the last one has arrived."""
        frames = list(rows)
        if frame_rate_hz is None:
            steps_s = np.diff([time_s for time_s, _, _ in frames])
            steps_s = steps_s[steps_s > 0]
            frame_rate_hz = float(1.0 / np.median(steps_s)) if len(steps_s) else 50.0
        faps = np.array([values for _, _, values in frames], np.float32).reshape(-1, NUM_FAPS)
        write_fap(self._output, FapAnimation(self._output.stem, frame_rate_hz, faps))
        return len(frames)


class GlbExporter(CurveExporter):
    """Writes the head as a GLB with the motion as an animation."""

    forms = (CurveForm.FAPS, CurveForm.ARKIT)

    def write(self, rows: Iterable[Row], frame_rate_hz: float | None = None) -> int:
        """Write the frames when the last one has arrived."""
        from kouxing.services.driver.head.glb_export import export_glb  # noqa: PLC0415 - slow
        from kouxing.services.driver.render.scene import load_head  # noqa: PLC0415

        frames = [(time_s, faps) for time_s, _, faps in rows]
        is_arkit = self._form is CurveForm.ARKIT
        export_glb(load_head(self._head), self._output, frames, as_arkit=is_arkit)
        return len(frames)


CURVE_EXPORTERS: dict[str, type[CurveExporter]] = {
    ".fap": FapExporter,
    ".csv": CsvExporter,
    ".jsonl": JsonLinesExporter,
    ".glb": GlbExporter,
}


def json_line(row: Row, form: CurveForm) -> str:
    """Return a JSON object for a frame: FAPs in the order of their numbers, or named shapes."""
    time_s, number, faps = row
    is_faps = form is CurveForm.FAPS
    rounded = [round(float(value), 2 if is_faps else 4) for value in _values(faps, form)]
    values = rounded if is_faps else dict(zip(_value_names(form), rounded, strict=True))
    return json.dumps({"time_s": time_s, "sequence": number, form.value: values})


def _write_lines(output: Path, lines: Iterable[str]) -> int:
    """Write each line when it arrives; return their number."""
    count = 0
    try:
        with output.open("w", encoding="utf-8", newline="") as file:
            for count, line in enumerate(lines, start=1):  # noqa: B007
                file.write(line + "\n")
                file.flush()
    except OSError as error:
        raise cannot_write(output, error) from None
    return count


def _value_names(form: CurveForm) -> tuple[str, ...]:
    shapes = SHAPE_SETS.get(form)
    return shapes.names if shapes else tuple(fap.name for fap in FAPS)


def _values(faps: Values, form: CurveForm) -> Values:
    shapes = SHAPE_SETS.get(form)
    return shapes.weights(faps) if shapes else faps
