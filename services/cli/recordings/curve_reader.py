"""Reads the motion of a face from a table of ``CsvExporter`` or ``JsonLinesExporter``.

Tables of spreadsheet programs may be in UTF-16, and have semicolons or tabs with decimal commas.
Takes of the Live Link Face app (CSV) are also read. Their frames without a face, with a count of 0,
are left out. Their time code is HH:MM:SS:FF.fff, where FF.fff counts frames. The file does not name
their rate. It is taken as the lowest standard rate above the largest FF. If a take does not cross a
full second, it is taken as the app's default.
"""

import codecs
import csv
import difflib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kouxing.services.senders.live_link import ANGLES
from kouxing.shared.arrays import Doubles
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import MAX_FRAMES, FapAnimation
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.shape_names import find_shapes
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.files.user_file import parse_json, read_file, split_lines

TABLE_SUFFIXES = (".csv", ".jsonl")
MAX_BYTES = 128 << 20  # about two hours
_MAX_FAP = 1e6
_MAX_WEIGHT = 10.0  # limit for the weight of a shape; percentages are larger
_TIME_CODE = re.compile(r"(\d+):(\d+):(\d+)[:;](\d+(?:\.\d+)?)")  # ";" if frames are dropped
_TIME_CODE_RATES_HZ = (24, 25, 30, 48, 50, 60, 100, 120)  # the app's default is 60
_DAY_S = 86400.0
_ROUNDING_S = 0.0015  # steps between times in whole milliseconds differ by up to 1 ms
_OTHER_COLUMNS = {"", "time_s", "sequence", "phone", "timecode", "blendshapecount"}
_OTHER_COLUMNS |= {angle.lower() for angle in ANGLES}
_HEAD_FAPS = dict(zip(ANGLES, ("head_yaw", "head_pitch", "head_roll"), strict=False))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """The columns of a table that are read, by index."""

    num_columns: int
    time: int
    is_time_code: bool  # whether the times are time codes, not seconds
    face_count: int | None  # a count of 0 means that a frame has no face
    values: list[int]  # FAPs or shapes
    basis: Doubles  # FAPs (columns, 68) of each column in ``values`` at a value of 1
    are_shapes: bool  # whether ``values`` are the weights of shapes, 0 to 1


def read_table(path: Path) -> FapAnimation:
    """Read a table of FAPs or shapes and resample it at its median frame rate.

    Raises ``UserError`` if the file cannot be read, has no times, no known column, or a value that
    is not a number.
    """
    lines = _read_lines(path)
    is_json = path.suffix.lower() == ".jsonl"
    rows = _json_rows(path, lines) if is_json else _csv_rows(path, lines)
    columns = _find_columns(path, [str(name).strip() for name in next(rows, [])])
    times, values = _read_frames(path, rows, columns)
    times_s = _parse_times_s(path, times, is_time_code=columns.is_time_code)
    animation = _resample(path, times_s, values @ columns.basis)
    return animation if columns.is_time_code else replace(animation, start_s=float(times_s[0]))


def _find_columns(path: Path, header: list[str]) -> _Columns:
    """Find the columns to read, and print the names of unknown columns."""
    if not header:
        raise UserError(f"{path}: the file is empty; export the curves again")
    names = [name.lower() for name in header]
    time_name = next((name for name in ("time_s", "timecode") if name in names), None)
    if time_name is None:
        raise UserError(
            f"{path}: no column is named time_s or Timecode; the columns are"
            f" {', '.join(header)}; rename the time column"
        )
    columns, basis = _known_columns(path, header)
    expected = {*_OTHER_COLUMNS, *(names[column] for column in columns)}
    if ignored := [name for name in header if name.lower() not in expected]:
        print_message(f"{path}: ignored unknown columns: {', '.join(map(_hint, ignored))}")
    return _Columns(
        num_columns=len(names),
        time=names.index(time_name),
        is_time_code=time_name == "timecode",
        face_count=names.index("blendshapecount") if "blendshapecount" in names else None,
        values=columns,
        basis=basis,
        are_shapes=names[columns[0]] not in FAP_NUMBER,
    )


def _read_frames(
    path: Path, rows: Iterable[list[str]], columns: _Columns
) -> tuple[list[str], Doubles]:
    """Return the times (n,), still as text, and the values (n, columns) of frames with a face."""
    times: list[str] = []
    values: list[Doubles] = []
    for number, row in enumerate(rows, start=1):
        count = columns.face_count
        if count is not None and row[count : count + 1] == ["0"]:
            continue
        frame = _parse_values(row, columns)
        if frame is None:
            raise UserError(f"{path}, frame {number}: a value is missing or not a number")
        if columns.are_shapes and (np.abs(frame) > _MAX_WEIGHT).any():
            raise UserError(
                f"{path}, frame {number}: values of shapes must be from 0 to 1; divide percentages"
                " by 100"
            )
        if number > MAX_FRAMES:
            raise UserError(f"{path}: the table has more than {MAX_FRAMES} frames; split it")
        times.append(row[columns.time])
        values.append(frame)
    if not times:
        raise UserError(f"{path}: the table has no frames with a face; record it again")
    return times, np.array(values)


def _parse_values(row: list[str], columns: _Columns) -> Doubles | None:
    """Return the values (columns,) of a row; None if one is missing or not a number."""
    if len(row) != columns.num_columns:
        return None
    try:
        values = np.array([row[column] for column in columns.values], np.float64)
    except (ValueError, TypeError, OverflowError):
        return None
    is_valid = values.ndim == 1 and (np.abs(values) <= _MAX_FAP).all()
    return values if is_valid else None


def _hint(column: str) -> str:
    """Return the name of an unknown column, with the nearest known name, if any."""
    known = [*FAP_NUMBER, *itertools.chain(*(shapes.names for shapes in SHAPE_SETS.values()))]
    nearest = difflib.get_close_matches(column, known, n=1, cutoff=0.8)
    return f"{column} (did you mean {nearest[0]}?)" if nearest else column


def _read_lines(path: Path) -> Iterator[str]:
    content = read_file(path, MAX_BYTES)
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise UserError(f"{path}: this is not a text file; use a table of curves in UTF-8")
    return (line for line in split_lines(path, text) if line.strip(" ,;\t\n"))


def _csv_rows(path: Path, lines: Iterator[str]) -> Iterator[list[str]]:
    """Yield the cells of each line, separated by commas, semicolons or tabs."""
    header = next((line for line in lines if not line.startswith("sep=")), "")  # from Excel
    delimiter = max(",;\t", key=header.count)
    try:
        for row in csv.reader(itertools.chain([header], lines), delimiter=delimiter):
            yield [cell.replace(",", ".") for cell in row]
    except csv.Error as error:
        raise UserError(f"{path}: this is not a table: {error}; export it again") from None


def _json_rows(path: Path, lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the names of the first frame, then the values of each frame."""
    names: list[str] = []
    for number, line in enumerate(lines, start=1):
        try:
            frame = parse_json(line)
            values = next(frame[key] for key in ("faps", *SHAPE_SETS) if key in frame)
            if isinstance(values, list):
                values = dict(zip(FAP_NUMBER, values, strict=True))
            fields = {"time_s": frame["time_s"], **values}
            if not names:
                names = list(fields)
                yield names
            if len(fields) != len(names):
                raise ValueError
            yield [fields[name] for name in names]
        except (ValueError, TypeError, LookupError, StopIteration):
            raise UserError(
                f"{path}, line {number}: expected an object with time_s, and the values of a"
                f" face in {', '.join(('faps', *SHAPE_SETS))}; all lines need the same values"
            ) from None


def _known_columns(path: Path, names: list[str]) -> tuple[list[int], Doubles]:
    """Return the columns of FAPs or of one set of shapes, and their FAPs at a value of 1.

    Shapes may have any name that other programs give them. Several columns that form one shape
    share its FAPs.
    """
    fap_rows = np.eye(NUM_FAPS)
    faps = [name for name in names if name.lower() in FAP_NUMBER]
    tables = [{name: fap_rows[FAP_NUMBER[name.lower()] - 1] for name in faps}]
    for set_name, shapes in SHAPE_SETS.items():
        shape_of = find_shapes(set_name, names)
        parts = Counter(shape_of.values())
        basis = dict(zip(shapes.names, shapes.basis, strict=True))
        tables.append({name: basis[shape] / parts[shape] for name, shape in shape_of.items()})
    known = max(tables, key=len)
    if not known:
        raise UserError(
            f"{path}: no column is named after a FAP or a shape such as jawOpen; rename the columns"
        )
    folded = [name.lower() for name in names]
    for name in known:
        if folded.count(name.lower()) > 1:
            raise UserError(f"{path}: two columns have the name {name}; rename or delete one")
    for angle, fap in _HEAD_FAPS.items():
        if angle.lower() in folded:
            known[angle] = fap_rows[FAP_NUMBER[fap] - 1] / RADIANS_PER_ANGLE_UNIT
    return [folded.index(name.lower()) for name in known], np.array([*known.values()])


def _parse_times_s(path: Path, times: list[str], *, is_time_code: bool) -> Doubles:
    try:
        codes = [_TIME_CODE.fullmatch(str(time).strip()) for time in times]
        values = [code.groups() if code else () for code in codes] if is_time_code else times
        fields = np.array(values, np.float64)
        if len(fields.T) == 0 or not np.isfinite(fields).all():
            raise ValueError
    except (ValueError, OverflowError):
        form = "a time code HH:MM:SS:FF.fff" if is_time_code else "a time in seconds"
        raise UserError(f"{path}: every line needs {form}") from None
    if not is_time_code:
        return fields
    hours, minutes, seconds, frames = fields.T
    lowest_hz = frames.max() if len(np.unique(seconds)) > 1 else max(59, frames.max())
    rate_hz = next((rate for rate in _TIME_CODE_RATES_HZ if lowest_hz < rate), 60)
    times_s: Doubles = 3600 * hours + 60 * minutes + seconds + frames / rate_hz
    midnights = np.cumsum(np.diff(times_s, prepend=times_s[0]) < -_DAY_S / 2)
    return times_s + midnights * _DAY_S


def _resample(path: Path, times_s: Doubles, faps: Doubles) -> FapAnimation:
    steps_s = np.diff(times_s)
    if (steps_s < 0).any():
        number = int(np.argmax(steps_s < 0)) + 2
        raise UserError(
            f"{path}, frame {number}: its time is earlier than the previous frame's;"
            " sort the frames by time"
        )
    times_s, first = np.unique(times_s - times_s[0], return_index=True)
    rate_hz = median_rate_hz(times_s)
    if not 1.0 <= rate_hz <= 1000.0:
        raise UserError(f"{path}: the times must match a rate of 1 to 1000 frames per second")
    if times_s[-1] > (MAX_FRAMES - 1) / rate_hz:
        raise UserError(
            f"{path}: the times span {times_s[-1]:.0f} s, more than {MAX_FRAMES} frames at"
            f" {rate_hz:g} per second; split the table"
        )
    grid_s = np.arange(round(times_s[-1] * rate_hz) + 1) / rate_hz
    resampled = np.empty((len(grid_s), faps.shape[1]), np.float32)
    for index, column in enumerate(faps[first].T):
        resampled[:, index] = np.interp(grid_s, times_s, column)
    return FapAnimation(path.stem, rate_hz, resampled)


def median_rate_hz(times_s: Doubles) -> float:
    """Return the median frame rate. Averaging equal steps cancels the rounding of their times."""
    steps_s = np.diff(times_s)
    steps_s = steps_s[steps_s > 0]
    if not len(steps_s):
        return 50.0
    median_s = np.quantile(steps_s, 0.5, method="lower")  # one of the steps
    usual = np.abs(steps_s - median_s) < _ROUNDING_S
    return 1.0 / float(steps_s[usual].mean())
