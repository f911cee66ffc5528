"""The output formats of ``kouxing render``. The suffix of the file chooses the class."""

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import ClassVar, TypeAlias

from rich.progress import Progress

from kouxing.services.cli.options import ExportOptions
from kouxing.services.cli.recordings.animation import FaceMotion, slow_down
from kouxing.services.cli.recordings.captions import make_captions
from kouxing.services.cli.recordings.curve_exporters import CURVE_EXPORTERS, CurveExporter
from kouxing.services.driver.config import check_even, parse_size
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.captions import band_height_px
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySideRenderer
from kouxing.services.driver.video import film
from kouxing.services.driver.video.video_writer import (
    VIDEO_SUFFIXES,
    check_name,
    existing_pictures,
    is_sequence,
)
from kouxing.shared.errors import UserError

_DRAWING_OPTIONS = frozenset({"lips", "head", "size", "background", "camera", "captions"})


class PictureExporter:
    """Draws one picture (PNG).

    Raises ``UserError`` if the options do not fit the format or each other.
    """

    unit: ClassVar[str] = "image"
    options: ClassVar[frozenset[str]] = _DRAWING_OPTIONS | {"at_s"}

    def __init__(self, output: Path, options: ExportOptions) -> None:
        self._output = output
        self._options = options
        self._size_px = _parse_size(options.size, even=output.suffix.lower() in VIDEO_SUFFIXES)
        self._renderer = _make_renderer(output, options, self._size_px)

    def export(self, motion: FaceMotion, progress: Progress) -> int:
        """Draw a motion and return the number of images.

        Raises ``UserError`` if a file cannot be written.
        """
        captions = make_captions(self._options.captions, motion, self._size_px)
        at_s = self._options.at_s or 0.0
        film.render_picture(motion.frames, self._output, self._renderer, at_s, captions)
        return 1

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


class VideoExporter(PictureExporter):
    """Draws a video, or a numbered picture for each of its images, such as ``face%05d.png``."""

    options: ClassVar[frozenset[str]] = _DRAWING_OPTIONS | {"rate_hz", "sound", "speed"}

    def __init__(self, output: Path, options: ExportOptions) -> None:
        check_name(output)
        super().__init__(output, options)

    def export(self, motion: FaceMotion, progress: Progress) -> int:
        """Draw a motion and return the number of images; raises as ``PictureExporter.export``."""
        task = progress.add_task("drawing", total=1.0)
        motion = slow_down(motion, self._options.speed)
        return film.render_video(
            motion.frames,
            self._output,
            self._renderer,
            frame_rate_hz=self._options.rate_hz or motion.image_rate_hz,
            samples=motion.samples,
            captions=make_captions(self._options.captions, motion, self._size_px),
            on_progress=lambda fraction: progress.update(task, completed=fraction),
        )


Exporter: TypeAlias = PictureExporter | CurveExporter
EXPORTERS: dict[str, type[Exporter]] = {
    **dict.fromkeys(VIDEO_SUFFIXES, VideoExporter),
    ".png": PictureExporter,
    **CURVE_EXPORTERS,
}


def is_output(path: Path) -> bool:
    """Return whether a path is a file or a folder that an exporter writes."""
    return is_sequence(path) or path.suffix.lower() in EXPORTERS


def existing_output(output: Path) -> Sequence[Path] | Path | None:
    """Return the files to replace: the existing pictures of a sequence, or the output."""
    if is_sequence(output) and (pictures := existing_pictures(output)):
        return pictures
    return None if output.is_dir() else output


def open_exporter(output: Path, options: ExportOptions) -> Exporter:
    """Return the exporter for a file, a folder or a numbered name.

    Raises ``UserError`` if the suffix is unknown, or the options do not fit the format.
    """
    exporter = VideoExporter if is_sequence(output) else EXPORTERS.get(output.suffix.lower())
    if exporter is None:
        raise UserError(
            f"{output}: unknown format; use a name that ends in {', '.join(EXPORTERS)}, a folder,"
            " or a name with a number such as face%05d.png"
        )
    _check_options(output, options, exporter)
    return exporter(output, options)


def _check_options(output: Path, options: ExportOptions, exporter: type[Exporter]) -> None:
    for field in fields(ExportOptions):
        name = field.name
        if getattr(options, name) != field.default and name not in exporter.options:
            suffixes = [suffix for suffix, cls in EXPORTERS.items() if name in cls.options]
            option = {"curve_format": "as", "rate_hz": "rate", "at_s": "at"}.get(name, name)
            raise UserError(
                f"{output}: --{option} does not apply to this format; it applies to"
                f" {', '.join(suffixes)}"
            )


def _make_renderer(
    output: Path, options: ExportOptions, size_px: tuple[int, int]
) -> Renderer | SideBySideRenderer:
    """Return a renderer that draws a face for each lip model, side by side, above captions."""
    num_faces = len(options.lips)
    width_px, height_px = size_px
    if options.captions is not None:
        height_px -= band_height_px(size_px)
    if width_px % num_faces:
        raise UserError(f"--size {options.size}: choose a width that is a multiple of {num_faces}")
    background = scene.parse_background(options.background)
    if background is None and output.suffix.lower() == ".mp4":
        raise UserError("MP4 has no transparency; write .mov, .webm or pictures (.png)")
    head = scene.load_head(options.head)
    camera = scene.place_camera(head, options.camera)
    renderer = Renderer(
        head, width_px // num_faces, height_px, background=background, camera=camera
    )
    if num_faces == 1:
        return renderer
    return SideBySideRenderer(renderer, [f"lips: {name}" for name in options.lips])


def _parse_size(text: str, *, even: bool) -> tuple[int, int]:
    try:
        size_px = parse_size(text)
        if even:
            check_even(size_px)
    except ValueError as error:
        raise UserError(f"--size {text}: {error}") from None
    return size_px
