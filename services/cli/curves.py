"""The curves of a face's motion as files: FAPs, or blend shapes; an animated head."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.cli.offline import CurveForm
from shared.errors import UserError
from shared.face.blendshapes import ARKIT_NAMES, OCULUS_NAMES, arkit_weights, oculus_weights
from shared.face.fap_file import FapAnimation, write_fap
from shared.face.faps import FAPS

if TYPE_CHECKING:
    from services.cli.motion import Motion

Values = NDArray[np.float32]
CURVE_SUFFIXES = (".fap", ".csv", ".jsonl", ".glb")
_FORMS_OF_SUFFIX = {
    ".fap": (CurveForm.FAPS,),
    ".glb": (CurveForm.FAPS, CurveForm.ARKIT),
}
_NAMES = {
    CurveForm.FAPS: tuple(fap.name for fap in FAPS),
    CurveForm.ARKIT: ARKIT_NAMES,
    CurveForm.OCULUS: OCULUS_NAMES,
}
_WEIGHTS: dict[CurveForm, Callable[[Values], Values]] = {
    CurveForm.FAPS: lambda faps: faps,
    CurveForm.ARKIT: arkit_weights,
    CurveForm.OCULUS: oculus_weights,
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
        from services.driver.head.glb_export import export_glb  # noqa: PLC0415 - it draws
        from services.driver.render.scene import load_head  # noqa: PLC0415

        export_glb(load_head(head), output, motion.frames, as_arkit=form is CurveForm.ARKIT)
        return
    rows = [(time_s, _WEIGHTS[form](faps)) for time_s, faps in motion.frames]
    try:
        with output.open("w", encoding="utf-8", newline="") as file:
            if suffix == ".csv":
                _write_csv(file, _NAMES[form], rows)
            else:
                file.writelines(
                    json_line(time_s, number, values, form) + "\n"
                    for number, (time_s, values) in enumerate(rows)
                )
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from None


def json_line(time_s: float, number: int, values: Values, form: CurveForm = CurveForm.FAPS) -> str:
    """Write a frame as a line of JSON: FAPs in the order of their numbers, else by name."""
    rounded = [round(float(value), 2 if form is CurveForm.FAPS else 4) for value in values]
    named = rounded if form is CurveForm.FAPS else dict(zip(_NAMES[form], rounded, strict=True))
    return json.dumps({"time_s": time_s, "sequence": number, form.value: named})


def _write_csv(file: IO[str], names: tuple[str, ...], rows: list[tuple[float, Values]]) -> None:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time_s", *names])
    for time_s, values in rows:
        writer.writerow([f"{time_s:.3f}", *(f"{value:.4g}" for value in values)])
