"""The output formats of ``kouxing render``: one class per format, found by the file's suffix."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Protocol

from rich.progress import Progress

from kouxing.services.cli.animation import Motion
from kouxing.services.cli.curves import CURVE_EXPORTERS
from kouxing.services.cli.options import ExportOptions
from kouxing.services.cli.pictures import PictureExporter, VideoExporter
from kouxing.services.driver.video.writer import VIDEO_SUFFIXES, is_sequence
from kouxing.shared.errors import UserError


class Exporter(Protocol):
    """Writes the motion of a face in one format."""

    unit: ClassVar[str]  # what ``export`` counts

    def __init__(self, output: Path, options: ExportOptions) -> None:
        """Check output and options. This comes before long work."""

    def export(self, motion: Motion, progress: Progress) -> int:
        """Write the motion and return the number of frames or images."""


EXPORTERS: dict[str, type[Exporter]] = {
    **dict.fromkeys(VIDEO_SUFFIXES, VideoExporter),
    ".png": PictureExporter,
    **CURVE_EXPORTERS,
}


def open_exporter(output: Path, options: ExportOptions) -> Exporter:
    """Return the exporter for a file, a folder or a numbered name.

    Raises ``UserError`` if the suffix is unknown, or the options do not fit the format.
    """
    if is_sequence(output):
        return VideoExporter(output, options)
    exporter = EXPORTERS.get(output.suffix.lower())
    if exporter is None:
        raise UserError(
            f"{output}: unknown format; give a name that ends in {', '.join(EXPORTERS)}, a folder,"
            " or a name with a number such as face%05d.png"
        )
    return exporter(output, options)
