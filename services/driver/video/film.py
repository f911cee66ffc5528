"""Renders FAP frames or a FAP file to a video or pictures, without running services."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from kouxing.services.driver.render.captions import CaptionDrawer
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySideRenderer
from kouxing.services.driver.video.video_renderer import VideoRenderer, interpolate
from kouxing.services.driver.video.video_writer import write_picture
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation
from kouxing.shared.face.high_level_faps import expression_faps, viseme_faps

# media time in seconds, and FAPs (68,); for faces side by side (num_faces, 68)
TimedFaps = tuple[float, Floats]


def expand_frames(animation: FapAnimation) -> list[TimedFaps]:
    """Return the frames of a FAP file, with FAP 1 and FAP 2 expanded into the other FAPs.

    A frame that defines a viseme or expression (``viseme_def``, ``expression_def``) already has the
    whole shape in its other FAPs, so nothing is added.
    """
    faps = animation.faps.copy()
    for number in range(len(faps)):
        if animation.visemes is not None:
            select1, select2, blend, is_definition = animation.visemes[number].tolist()
            if not is_definition:
                faps[number] += viseme_faps(select1, select2, blend)
        if animation.expressions is not None:
            *selected, _, is_definition = animation.expressions[number].tolist()
            if not is_definition:
                faps[number] += expression_faps(*selected)
    return [(number / animation.frame_rate_hz, row) for number, row in enumerate(faps)]


def stack_faces(faces: Sequence[list[TimedFaps]]) -> list[TimedFaps]:
    """Combine the frames of several faces, at the same times, for ``SideBySideRenderer``."""
    return [
        (frames[0][0], np.stack([faps for _, faps in frames]))
        for frames in zip(*faces, strict=True)
    ]


def render_video(
    frames: list[TimedFaps],
    path: Path,
    renderer: Renderer | SideBySideRenderer,
    *,
    frame_rate_hz: float,
    samples: Floats | None,
    captions: CaptionDrawer | None = None,
    on_progress: Callable[[float], None] = lambda _fraction: None,
) -> int:
    """Write a video or one picture per image; return the number of images.

    The last of the ``frames``, at least one, is held until the sound (n,), 16 kHz mono, ends.
    ``captions`` are drawn below the images.
    ``on_progress`` is called with the finished fraction, 0 to 1.

    Raises ``UserError`` if the file cannot be written.
    """
    video = VideoRenderer(
        path, renderer, frame_rate_hz, with_audio=samples is not None, captions=captions
    )
    sound = np.zeros(0, np.float32) if samples is None else samples
    num_sent = 0
    try:
        if len(sound) / MEDIA_RATE_HZ > frames[-1][0]:
            frames = [*frames, (len(sound) / MEDIA_RATE_HZ, frames[-1][1])]
        for time_s, faps in frames:
            video.add_frame(time_s, faps)
        while video.step():
            end = round(video.duration_s * MEDIA_RATE_HZ)
            video.add_audio(num_sent, sound[num_sent:end])
            num_sent = min(end, len(sound))
            on_progress(min(1.0, video.duration_s / max(frames[-1][0], 1e-9)))
        video.add_audio(num_sent, sound[num_sent:])
    except BaseException:
        video.discard()
        raise
    video.close()
    return video.num_images


def render_picture(
    frames: list[TimedFaps],
    path: Path,
    renderer: Renderer | SideBySideRenderer,
    at_s: float,
    captions: CaptionDrawer | None,
) -> None:
    """Write the picture (PNG) at a time, with captions below it.

    Raises ``UserError`` if the time is outside the animation, or the file cannot be written.
    """
    last_s = frames[-1][0]
    if not 0 <= at_s <= last_s:
        raise UserError(f"--at {at_s:g} is outside the animation; use 0 to {last_s:g} seconds")
    times_s = [time_s for time_s, _ in frames]
    after = min(int(np.searchsorted(times_s, at_s, side="right")), len(frames) - 1)
    pair = frames[max(after - 1, 0)], frames[after]
    image = renderer.draw(interpolate(*pair, at_s))
    write_picture(path, image if captions is None else captions.add_below(image, at_s))
