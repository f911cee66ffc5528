"""Videos and pictures of a face's motion, without running services."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import Progress

from kouxing.services.cli.curves import CURVE_SUFFIXES
from kouxing.services.cli.motion import Motion
from kouxing.services.driver.config import Framing
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySide
from kouxing.services.driver.video import film
from kouxing.services.driver.video.writer import VIDEO_SUFFIXES, check_name, is_sequence
from kouxing.shared.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """How the head is shown; the fields are options of ``kouxing render``."""

    head: str
    size: str
    background: str
    camera: Framing
    yaw_deg: float
    pitch_deg: float
    rate_hz: float | None  # images per second; None: as the motion has
    at_s: float | None  # of one picture


def is_picture(output: Path) -> bool:
    """Whether a name stands for one picture."""
    return output.suffix == ".png" and not is_sequence(output)


def check_pictures(output: Path, shot: Shot) -> None:
    """Check a name of a video or of pictures before long work.

    Raises
    ------
    UserError
        If it is none, or the options do not fit it.
    """
    if shot.at_s is not None and not is_picture(output):
        raise UserError("--at says when one picture is taken; give the name of one (.png)")
    if not is_picture(output):
        check_name(output, (".png", *CURVE_SUFFIXES))


def draw(
    motion: Motion,
    renderer: Renderer | SideBySide,
    output: Path,
    shot: Shot,
    progress: Progress,
) -> int:
    """Make a video, one picture or a picture for every image; return the number of images.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    if is_picture(output):
        film.render_picture(motion.frames, output, renderer, shot.at_s or 0.0)
        return 1
    drawing = progress.add_task("drawing", total=1.0)
    return film.render_video(
        motion.frames,
        output,
        renderer,
        frame_rate_hz=shot.rate_hz or motion.image_rate_hz,
        samples=motion.samples,
        on_progress=lambda share: progress.update(drawing, completed=share),
    )


def make_renderer(shot: Shot, output: Path, lips: Sequence[str]) -> Renderer | SideBySide:
    """Set up the drawing of a face for each lip model.

    Raises
    ------
    UserError
        If the options do not fit each other.
    """
    width_px, height_px = _parse_size(shot.size, even=output.suffix in VIDEO_SUFFIXES)
    if width_px % len(lips):
        raise UserError(f"--size {shot.size}: {len(lips)} faces need a width that they can share")
    background = scene.background(shot.background)
    if background is None and output.suffix == ".mp4":
        raise UserError("MP4 has no transparency; write .mov, .webm, or pictures (.png)")
    head = scene.load_head(shot.head)
    camera = scene.camera(head, shot.camera, shot.yaw_deg, shot.pitch_deg)
    renderer = Renderer(
        head, width_px // len(lips), height_px, background=background, camera=camera
    )
    return renderer if len(lips) == 1 else SideBySide(renderer, [f"lips: {name}" for name in lips])


def _parse_size(text: str, *, even: bool) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"--size {text}: write WIDTHxHEIGHT, for example 1280x720")
    width_px, height_px = int(width), int(height)
    if not (16 <= width_px <= 7680 and 16 <= height_px <= 4320):
        raise UserError(f"--size {text}: 16x16 to 7680x4320")
    if even and (width_px % 2 or height_px % 2):
        raise UserError(f"--size {text}: both must be even for a video")
    return width_px, height_px
