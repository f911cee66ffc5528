"""Exports the curves of a face: FAPs or blendshapes of every frame.

To add a format, write a subclass of ``CurveExporter`` and add its suffix to ``CURVE_EXPORTERS``.
``kouxing render`` and ``kouxing listen`` then write it. ``curve_reader`` reads tables.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np
from rich.progress import Progress

from kouxing.services.cli.options import CurveFormat, ExportOptions
from kouxing.services.cli.recordings.cue_files import CUE_FORMATS, CUE_KINDS, format_cues
from kouxing.services.cli.recordings.curve_reader import median_rate_hz
from kouxing.services.senders import live_link
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import print_message, write_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, write_fap
from kouxing.shared.face.faps import FAPS, NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.files.output_file import open_output, write_error
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.transcript import TimedSyllable

if TYPE_CHECKING:
    from kouxing.services.cli.recordings.animation import FaceMotion

T = TypeVar("T", Phone, TimedSyllable)
Values = Floats
FrameRow = tuple[float, int, Values]  # media time in seconds, frame number, FAPs (68,)
_SHAPE_FORMATS = (CurveFormat.ARKIT, CurveFormat.OCULUS, CurveFormat.VRM)
_LIVE_LINK_RATE_HZ = 60  # rate of the time code; the app's default
# The time code does not contain its rate, so readers infer it from the highest frame count. At
# lower rates, there may be no count of 50 or more, and readers would infer 50 frames per second.
_MIN_LIVE_LINK_FRAMES_HZ = 6
_MIN_REPORTED_START_S = 0.1


@dataclass(frozen=True, slots=True)
class FrameStream:
    """The frames of a face, written as they arrive."""

    rows: Iterable[FrameRow]
    frame_rate_hz: float | None = None  # None: estimated from the times of the frames
    phones: Sequence[Phone] | None = None  # spoken phones by onset; tables get a column for them
    source: Path | None = None  # recording
    duration_s: float | None = None  # duration of the recording; None: until the last frame
    is_live: bool = False


class CurveExporter(ABC):
    """Writes the curves of a face to a file.

    Raises ``UserError`` if the options do not fit the format, or the folder does not exist.
    """

    unit: ClassVar[str] = "frame"
    options: ClassVar[frozenset[str]] = frozenset({"lips", "curve_format"})
    formats: ClassVar[tuple[CurveFormat, ...]]  # the first one is the default

    def __init__(self, output: Path, options: ExportOptions) -> None:
        curve_format = options.curve_format or self.formats[0]
        if curve_format not in self.formats:
            suffixes = [
                name for name, cls in CURVE_EXPORTERS.items() if curve_format in cls.formats
            ]
            raise UserError(
                f"{output} cannot contain {curve_format}; use a name that ends in"
                f" {', '.join(suffixes)}"
            )
        if len(options.lips) > 1:
            raise UserError("a curve file holds one face; use --lips only once")
        if not output.parent.is_dir():
            raise write_error(output, FileNotFoundError())
        self._output = output
        self._curve_format = curve_format
        self._head = options.head

    def export(self, motion: FaceMotion, progress: Progress) -> int:
        """Write all frames of a motion and return their number."""
        rows = ((time_s, number, faps) for number, (time_s, faps) in enumerate(motion.frames))
        duration_s = None if motion.samples is None else len(motion.samples) / MEDIA_RATE_HZ
        return self.write(
            FrameStream(rows, motion.frame_rate_hz, motion.phones, motion.source, duration_s)
        )

    @abstractmethod
    def write(self, curves: FrameStream) -> int:
        """Write frames as they arrive and return their number.

        Raises ``UserError`` if the file cannot be written.
        """

    def _report_start(self, curves: FrameStream, start_s: float) -> None:
        """Report where a recording starts in its session, for a format without start times."""
        if curves.is_live and start_s >= _MIN_REPORTED_START_S:
            print_message(f"{self._output} starts at {start_s:.3f} s of the session")

    def close(self) -> None:  # noqa: B027 - not abstract: there is nothing to do
        """Release the exporter's resources. A curve exporter has no resources."""


class CsvExporter(CurveExporter):
    """Writes comma-separated values, with a column for each FAP or shape."""

    formats = tuple(name for name in CurveFormat if name is not CurveFormat.RHUBARB)

    def write(self, curves: FrameStream) -> int:
        """Write each frame when it arrives."""
        if self._curve_format is CurveFormat.LIVELINK:
            if (curves.frame_rate_hz or _LIVE_LINK_RATE_HZ) < _MIN_LIVE_LINK_FRAMES_HZ:
                raise UserError(
                    f"{self._output}: a take of Live Link Face needs at least"
                    f" {_MIN_LIVE_LINK_FRAMES_HZ} frames per second, but this motion has"
                    f" {curves.frame_rate_hz:g}; use --as arkit"
                )
            columns = _LIVE_LINK_COLUMNS
            cells = (_live_link_cells(row) for row in curves.rows)
        else:
            columns = ["time_s", *_value_names(self._curve_format)]
            columns += [] if curves.phones is None else ["phone"]
            cells = (_cells(row, self._curve_format, curves.phones) for row in curves.rows)
        return _write_lines(self._output, map(",".join, chain([columns], cells)), curves) - 1


class JsonLinesExporter(CurveExporter):
    """Writes a JSON object for each frame."""

    formats = (CurveFormat.FAPS, *_SHAPE_FORMATS)

    def write(self, curves: FrameStream) -> int:
        """Write each frame when it arrives."""
        lines = (json_line(row, self._curve_format, curves.phones) for row in curves.rows)
        return _write_lines(self._output, lines, curves)


class FapExporter(CurveExporter):
    """Writes an MPEG-4 ``.fap`` file."""

    formats = (CurveFormat.FAPS,)

    def write(self, curves: FrameStream) -> int:
        """Write the frames when the last one has arrived. Gaps repeat the face before them."""
        frames, frame_rate_hz = list(curves.rows), curves.frame_rate_hz
        times_s = np.array([time_s for time_s, _, _ in frames])
        if frame_rate_hz is None:
            frame_rate_hz = median_rate_hz(times_s)
        faps = np.array([values for _, _, values in frames], np.float32).reshape(-1, NUM_FAPS)
        if frames:
            self._report_start(curves, times_s[0])
            numbers = np.rint((times_s - times_s[0]) * frame_rate_hz)
            faps = faps[np.searchsorted(numbers, np.arange(numbers[-1] + 1), side="right") - 1]
        write_fap(self._output, FapAnimation(self._output.stem, frame_rate_hz, faps))
        return len(frames)


class GlbExporter(CurveExporter):
    """Writes the head as a GLB with the motion as an animation."""

    options = CurveExporter.options | {"head"}
    formats = (CurveFormat.FAPS, CurveFormat.ARKIT)

    def write(self, curves: FrameStream) -> int:
        """Write the frames when the last one has arrived. The first live frame is at 0 s."""
        from kouxing.services.driver.head.glb_export import export_glb  # noqa: PLC0415 - slow
        from kouxing.services.driver.render.scene import load_head  # noqa: PLC0415

        frames: list[tuple[float, Values]] = []
        for time_s, _, faps in curves.rows:
            if not frames or time_s > frames[-1][0]:  # media time stops while no audio arrives
                frames.append((time_s, faps))
        if frames and curves.is_live:
            self._report_start(curves, frames[0][0])
            frames = [(time_s - frames[0][0], faps) for time_s, faps in frames]
        is_arkit = self._curve_format is CurveFormat.ARKIT
        export_glb(load_head(self._head), self._output, frames, as_arkit=is_arkit)
        return len(frames)


class CueExporter(CurveExporter):
    """Writes cues in a format of Rhubarb Lip Sync: drawn mouths, or Oculus visemes."""

    formats = tuple(CUE_KINDS)

    def write(self, curves: FrameStream) -> int:
        """Write the cues when the last frame has arrived."""
        find_cues, rest = CUE_KINDS[self._curve_format]
        frames = [(time_s, faps) for time_s, _, faps in curves.rows]
        end_s = curves.duration_s or (frames[-1][0] if frames else 0.0)
        suffix = self._output.suffix.lower()
        write_text(self._output, format_cues(suffix, find_cues(frames), rest, end_s, curves.source))
        return len(frames)


CURVE_EXPORTERS: dict[str, type[CurveExporter]] = {
    ".fap": FapExporter,
    ".csv": CsvExporter,
    ".jsonl": JsonLinesExporter,
    ".glb": GlbExporter,
    **dict.fromkeys(CUE_FORMATS, CueExporter),
}


def json_line(
    row: FrameRow, curve_format: CurveFormat, phones: Sequence[Phone] | None = None
) -> str:
    """Return a JSON object for a frame: FAPs in the order of their numbers, or named shapes."""
    time_s, number, faps = row
    is_faps = curve_format is CurveFormat.FAPS
    rounded = [round(float(value), 2 if is_faps else 4) for value in _values(faps, curve_format)]
    values = rounded if is_faps else dict(zip(_value_names(curve_format), rounded, strict=True))
    fields = {"time_s": time_s, "sequence": number, curve_format.value: values}
    return json.dumps(fields if phones is None else {**fields, "phone": phone_at(phones, time_s)})


def phone_at(phones: Sequence[Phone], time_s: float) -> str:
    """Return the symbol of the phone at a time, or "" outside all phones."""
    phone = item_at(phones, time_s)
    return phone.symbol if phone else ""


def item_at(items: Sequence[T], time_s: float) -> T | None:
    """Return the phone or syllable at a time, or None. They are in order and may have gaps."""
    index = bisect_right(items, time_s, key=lambda item: item.onset_s) - 1
    return items[index] if index >= 0 and time_s < items[index].end_s else None


def _cells(row: FrameRow, curve_format: CurveFormat, phones: Sequence[Phone] | None) -> list[str]:
    time_s, _, faps = row
    cells = [f"{time_s:.3f}", *(f"{value:.4g}" for value in _values(faps, curve_format))]
    return cells if phones is None else [*cells, phone_at(phones, time_s)]


def _live_link_cells(row: FrameRow) -> list[str]:
    time_s, _, faps = row
    face = FaceFrame(faps, time_s)
    weights = face.weights(CurveFormat.ARKIT)
    milliframes = round(time_s * _LIVE_LINK_RATE_HZ * 1000)
    seconds, frame = divmod(milliframes, _LIVE_LINK_RATE_HZ * 1000)
    time_code = (
        f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}:{frame / 1000:06.3f}"
    )
    values = [*(weights[name] for name in _LIVE_LINK_SHAPES), *live_link.face_angles(face)]
    return [time_code, str(len(values)), *(f"{value:.6f}" for value in values)]


# The app's tables list the right jaw and mouth before the left, unlike its packets.
_SWAPPED = {"jawLeft": "jawRight", "mouthLeft": "mouthRight"}
_SWAPPED |= {right: left for left, right in _SWAPPED.items()}
_LIVE_LINK_SHAPES = [_SWAPPED.get(name, name) for name in live_link.ORDER]
_LIVE_LINK_COLUMNS = [
    "Timecode",
    "BlendShapeCount",
    *(name[0].upper() + name[1:] for name in _LIVE_LINK_SHAPES),
    *live_link.ANGLES,
]


def _write_lines(output: Path, lines: Iterable[str], curves: FrameStream) -> int:
    """Write each line when it arrives; return their number. An error leaves only live frames."""
    count = 0
    with open_output(output, keep_on_error=curves.is_live) as file:
        for count, line in enumerate(lines, start=1):  # noqa: B007
            file.write(f"{line}\n".encode())
            file.flush()
    return count


def _value_names(curve_format: CurveFormat) -> tuple[str, ...]:
    shapes = SHAPE_SETS.get(curve_format)
    return shapes.names if shapes else tuple(fap.name for fap in FAPS)


def _values(faps: Values, curve_format: CurveFormat) -> Values:
    shapes = SHAPE_SETS.get(curve_format)
    return shapes.weights(faps) if shapes else faps
