"""The curves of a face's motion as files: FAPs, or blend shapes; an animated head."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from kouxing.services.cli.options import CurveForm
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, write_fap
from kouxing.shared.face.faps import FAPS
from kouxing.shared.face.shapes import SHAPE_SETS

if TYPE_CHECKING:
    from kouxing.services.cli.motion import Motion

Values = NDArray[np.float32]
CURVE_SUFFIXES = (".fap", ".csv", ".jsonl", ".glb")
_FORMS_OF_SUFFIX = {
    ".fap": (CurveForm.FAPS,),
    ".glb": (CurveForm.FAPS, CurveForm.ARKIT),
}


def is_curves(output: Path) -> bool:
    """Whether a name stands for curves."""
    return output.suffix.lower() in CURVE_SUFFIXES


def check_curves(output: Path, form: CurveForm) -> None:
    """Check a name of a curve file before long work.

    Raises
    ------
    UserError
        If the file cannot hold such values.
    """
    forms = _FORMS_OF_SUFFIX.get(output.suffix.lower(), tuple(CurveForm))
    if form not in forms:
        raise UserError(
            f"{output}: such a file holds {' or '.join(forms)}; for {form} write .csv or .jsonl"
        )
    if not output.parent.is_dir():
        raise UserError(f"{output}: cannot be written: there is no folder {output.parent}")


def write_curves(motion: Motion, output: Path, form: CurveForm, head: str) -> None:
    """Write the values of every frame; the suffix tells how.

    Parameters
    ----------
    motion
        Of one face.
    output
        ``.fap``, ``.csv``, ``.jsonl``, or ``.glb``: the head with the motion as an animation.
    form
        What the values are.
    head
        The head of a ``.glb``.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    suffix = output.suffix.lower()
    if suffix == ".fap":
        faps = np.array([faps for _, faps in motion.frames], np.float32)
        write_fap(output, FapAnimation(output.stem, motion.frame_rate_hz, faps))
        return
    if suffix == ".glb":
        from kouxing.services.driver.head.glb_export import export_glb  # noqa: PLC0415 - it draws
        from kouxing.services.driver.render.scene import load_head  # noqa: PLC0415

        export_glb(load_head(head), output, motion.frames, as_arkit=form is CurveForm.ARKIT)
        return
    try:
        with output.open("w", encoding="utf-8", newline="") as file:
            write = row_writer(file, suffix, form)
            for number, (time_s, faps) in enumerate(motion.frames):
                write(time_s, number, faps)
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from None


def row_writer(file: IO[str], suffix: str, form: CurveForm) -> Callable[[float, int, Values], None]:
    """Begin a table of values; return what writes a row of it.

    Parameters
    ----------
    file
        Text file.
    suffix
        ``.csv``, else lines of JSON: FAPs in the order of their numbers, shapes by name.
    form
        What the values are.

    Returns
    -------
    Function of the media time in seconds, the frame's number, and its FAPs (68,).
    """
    shapes = SHAPE_SETS.get(form)
    names = shapes.names if shapes else tuple(fap.name for fap in FAPS)
    table = csv.writer(file, lineterminator="\n")

    def write_csv(time_s: float, _number: int, values: Values) -> None:
        table.writerow([f"{time_s:.3f}", *(f"{value:.4g}" for value in values)])

    def write_json(time_s: float, number: int, values: Values) -> None:
        rounded = [round(float(value), 4 if shapes else 2) for value in values]
        named = dict(zip(names, rounded, strict=True)) if shapes else rounded
        line = {"time_s": time_s, "sequence": number, form.value: named}
        file.write(json.dumps(line) + "\n")

    if suffix == ".csv":
        table.writerow(["time_s", *names])
    write = write_csv if suffix == ".csv" else write_json
    return lambda time_s, number, faps: write(
        time_s, number, shapes.weights(faps) if shapes else faps
    )
