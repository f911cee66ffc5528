"""Renders the video of one session while its FAP frames and audio arrive.

Images are interpolated between FAP frames by media time, at the video's own rate, so the video is
in sync at any rates, and with late frames.
"""

from collections import deque
from pathlib import Path

import numpy as np

from kouxing.services.driver.render.captions import CaptionDrawer
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySideRenderer
from kouxing.services.driver.video.video_writer import open_writer
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

MAX_SILENCE_S = 600.0  # longest gap in the audio that is filled with silence
Faps = Floats


class VideoRenderer:
    """Renders FAP frames to images, and writes them and the audio to a video.

    The file appears when the video is closed. A renderer with a transparent background makes a
    transparent video. Unless ``overwrite`` is set, ``close`` adds a number to the name of an
    existing file. ``captions`` are drawn below the images.

    Raises ``UserError`` if the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        renderer: Renderer | SideBySideRenderer,
        frame_rate_hz: float,
        *,
        with_audio: bool = True,
        overwrite: bool = True,
        captions: CaptionDrawer | None = None,
    ) -> None:
        self.path = path
        self.num_images = 0
        self._renderer = renderer
        self._frame_rate_hz = frame_rate_hz
        self._captions = captions
        width_px, height_px = renderer.size
        if captions is not None:
            height_px += captions.height_px
        self._frames: deque[tuple[float, Faps]] = deque()
        self._num_samples = 0
        self._writer = open_writer(
            path, (width_px, height_px), frame_rate_hz, MEDIA_RATE_HZ if with_audio else None,
            transparent=renderer.transparent, overwrite=overwrite,
        )  # fmt: skip

    @property
    def duration_s(self) -> float:
        """Length of the picture so far."""
        return self.num_images / self._frame_rate_hz

    @property
    def num_queued(self) -> int:
        """Number of received frames that are still needed."""
        return len(self._frames)

    def add_frame(self, time_s: float, faps: Faps) -> None:
        """Add a FAP frame. Times must not decrease."""
        if not self._frames or time_s > self._frames[-1][0]:
            self._frames.append((time_s, faps))

    def add_audio(self, media_time: int, samples: Floats) -> None:
        """Add audio (n,); a gap before it is filled with silence.

        Raises ``UserError`` if the gap is too long, or the file cannot be written.
        """
        missing = media_time - self._num_samples
        if missing > MAX_SILENCE_S * MEDIA_RATE_HZ:
            raise UserError(
                f"no video was written: {missing / MEDIA_RATE_HZ:.0f} s of audio are missing;"
                " record again"
            )
        if missing > 0:
            samples = np.concatenate([np.zeros(missing, np.float32), samples])
        elif missing < 0:
            samples = samples[-missing:]
        self._writer.write_audio(samples)
        self._num_samples += len(samples)

    def step(self) -> bool:
        """Render one image if its FAP frames have arrived; return whether an image was rendered."""
        time_s = self.num_images / self._frame_rate_hz
        while len(self._frames) > 1 and self._frames[1][0] <= time_s:
            self._frames.popleft()
        if not self._frames:
            return False
        last_s = self._frames[-1][0]
        if time_s > last_s:
            return False
        after = self._frames[min(1, len(self._frames) - 1)]
        image = self._renderer.draw(interpolate(self._frames[0], after, time_s))
        if self._captions is not None:
            image = self._captions.add_below(image, time_s)
        self._writer.write_image(image)
        self.num_images += 1
        return True

    def close(self) -> None:
        """Finish the file.

        Raises ``UserError`` if the video has no image, or the file cannot be written.
        """
        if not self.num_images:
            raise UserError("no frame arrived, so the video is empty; send audio and record again")
        self.path = self._writer.close()

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._writer.discard()


def interpolate(before: tuple[float, Faps], after: tuple[float, Faps], time_s: float) -> Faps:
    """Interpolate the FAPs between two frames. Outside, return the FAPs of the nearer frame."""
    (start_s, start), (end_s, end) = before, after
    if end_s <= start_s:
        return start
    weight = np.float32(np.clip((time_s - start_s) / (end_s - start_s), 0.0, 1.0))
    return start + (end - start) * weight
