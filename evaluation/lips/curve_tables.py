"""Tables of the curves that another lip-sync program produces for clips.

The column ``t`` is the duration of the audio that the program had received when it made the row,
seconds. The other columns are ARKit's shapes (``jawOpen``), Oculus' visemes (``aa`` or
``viseme_aa``) or ``opening``. Other columns are only inputs of the linear map.
"""

import csv
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.corpora.lip_clips import LipClip
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.shapes import ARKIT, OCULUS
from kouxing.shared.files.user_file import check_content, read_text, split_lines

TIME, OPENING = "t", "opening"
_MAX_BYTES = 64 << 20
_LOW, _HIGH = 1.0, 99.0  # percentiles
_MAX_OPENING = 400.0  # FAP units, 12 mm on a face
_READY_PLAYER_ME = {"I": "ih", "O": "oh", "U": "ou"}  # names of Oculus visemes in Ready Player Me
_LOWER_LIP = FAP_NUMBER["raise_b_midlip"] - 1


@dataclass(frozen=True, slots=True)
class CurveTable:
    """Curves of a clip."""

    time_s: Doubles  # (num_rows,), ascending
    names: tuple[str, ...]
    values: Doubles  # (num_rows, num_curves)

    def at(self, known_s: Doubles) -> Doubles:
        """Return the newest rows, (..., num_curves), that need no audio after the given times."""
        index = np.searchsorted(self.time_s, known_s + 1e-6, side="right") - 1
        return np.asarray(self.values[np.clip(index, 0, None)])


@dataclass(frozen=True, slots=True)
class FapConversion:
    """Converts curves to FAPs: ``basis`` (num_curves, 68) and ``offset`` (68,)."""

    basis: Doubles
    offset: Doubles

    def faps(self, curves: Doubles) -> Doubles:
        """Return FAPs (num_frames, 68) of curves (num_frames, num_curves)."""
        return np.asarray(curves @ self.basis + self.offset)


def read_tables(
    folder: Path, held_out: Sequence[LipClip], training: Sequence[LipClip]
) -> dict[str, CurveTable]:
    """Read ``CLIP.csv`` of all held-out clips, and of those training clips that have one.

    Raises ``UserError`` if a held-out clip has no table, a table cannot be read, or its columns
    differ from the first one's columns.
    """
    paths = {clip.name: folder / f"{clip.name}.csv" for clip in (*held_out, *training)}
    missing = [paths[clip.name] for clip in held_out if not paths[clip.name].is_file()]
    if missing:
        raise UserError(
            f"{folder}: {len(missing)} of {len(held_out)} held-out clips have no table; add"
            f" {missing[0].name}"
        )
    tables = {name: read_table(path) for name, path in paths.items() if path.is_file()}
    names = tables[held_out[0].name].names
    for name, table in tables.items():
        if table.names != names:
            raise UserError(
                f"{paths[name]}: its columns differ from the columns of {held_out[0].name}.csv"
            )
    return tables


def read_table(path: Path) -> CurveTable:
    """Read a table; UserError if it cannot be read, or has an invalid row."""
    with check_content(path, "a table with a column t and a column for each curve"):
        rows = csv.reader(split_lines(path, read_text(path, _MAX_BYTES)))
        names = [name.strip() for name in next(rows, [])]
        if TIME not in names or len({*names}) < len(names) or len(names) < 2:
            raise ValueError("the first line must name t and every curve once")
        values = np.array([[float(cell) for cell in row] for row in rows if row])
        if not len(values) or not np.isfinite(values).all():
            raise ValueError("it has no rows, or a value is not finite")
        time_s = values[:, names.index(TIME)]
        if values.shape[1] != len(names) or not (np.diff(time_s) > 0.0).all():
            raise ValueError(
                "a row has too many or too few values, or the times are not increasing"
            )
    values = np.delete(values, names.index(TIME), axis=1)
    return CurveTable(time_s, tuple(name for name in names if name != TIME), values)


def fap_conversion(folder: Path, tables: Collection[CurveTable]) -> FapConversion:
    """Return the conversion of a folder's curves to FAPs.

    Shapes have the FAPs of this package's tables. An opening has no unit. Over all tables, its
    first percentile is mapped to 0, and its 99th to 400 FAP units. Raises ``UserError`` if no
    column has a known name.
    """
    names = next(iter(tables)).names
    basis, offset = np.zeros((len(names), NUM_FAPS)), np.zeros(NUM_FAPS)
    if OPENING in names:
        column = names.index(OPENING)
        low, high = np.percentile(
            np.concatenate([table.values[:, column] for table in tables]), [_LOW, _HIGH]
        )
        scale = _MAX_OPENING / max(float(high - low), 1e-9)
        basis[column, _LOWER_LIP], offset[_LOWER_LIP] = -scale, scale * low
        return FapConversion(basis, offset)
    known: Mapping[str, Floats] = {
        name: row
        for shapes in (ARKIT, OCULUS)
        for name, row in zip(shapes.names, shapes.basis, strict=True)
    }
    for row, name in zip(basis, names, strict=True):
        viseme = name.removeprefix("viseme_")
        row[:] = known.get(_READY_PLAYER_ME.get(viseme, viseme), 0.0)
    if not basis.any():
        raise UserError(
            f"{folder}: no column is a curve of a mouth; name a column {OPENING}, jawOpen or"
            " another ARKit shape, or viseme_aa or another Oculus viseme"
        )
    return FapConversion(basis, offset)
