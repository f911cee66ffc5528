"""One session's video as its FAP frames and sound arrive.

Images are made at the video's own rate from the FAP frames around them, by media time, so the
video is in sync whatever the rates are and however late the frames come.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySide
from kouxing.services.driver.video.writer import open_writer
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

MAX_SILENCE_S = 600.0  # inserted for missing sound
Faps = NDArray[np.float32]


class Recording:
    """Writes images and sound to a video; the file appears when it is closed.

    Parameters
    ----------
    path
        As ``open_writer`` takes it.
    renderer
        What draws; its background decides whether the video is transparent.
    frame_rate_hz
        Images a second.
    sound
        Whether there will be sound.
    overwrite
        Whether a video of that name is replaced; if not, ``close`` adds a number to ``path``.

    Raises
    ------
    UserError
        If the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        renderer: Renderer | SideBySide,
        frame_rate_hz: float,
        *,
        sound: bool = True,
        overwrite: bool = True,
    ) -> None:
        self.path = path
        self.num_images = 0
        self.ended = False
        self._renderer = renderer
        self._frame_rate_hz = frame_rate_hz
        self._frames: deque[tuple[float, Faps]] = deque()
        self._num_samples = 0
        self._writer = open_writer(
            path,
            renderer.size,
            frame_rate_hz,
            MEDIA_RATE_HZ if sound else None,
            transparent=renderer.transparent,
            overwrite=overwrite,
        )

    @property
    def duration_s(self) -> float:
        """Length of the picture so far."""
        return self.num_images / self._frame_rate_hz

    def accept_frame(self, time_s: float, faps: Faps) -> None:
        """Take a FAP frame as the renderer draws it; times do not decrease."""
        if not self._frames or time_s > self._frames[-1][0]:
            self._frames.append((time_s, faps))

    def accept_sound(self, media_time: int, samples: NDArray[np.float32]) -> None:
        """Take sound of shape ``(n,)``; what is missing before it becomes silence.

        Raises
        ------
        UserError
            If very much is missing, or the file cannot be written.
        """
        missing = media_time - self._num_samples
        if missing > MAX_SILENCE_S * MEDIA_RATE_HZ:
            raise UserError(f"{missing / MEDIA_RATE_HZ:.0f} s of sound are missing; no video")
        if missing > 0:
            samples = np.concatenate([np.zeros(missing, np.float32), samples])
        elif missing < 0:
            samples = samples[-missing:]
        self._writer.write_sound(samples)
        self._num_samples += len(samples)

    def step(self) -> bool:
        """Render one image if the FAP frames for it are here; return whether one was due."""
        time_s = self.num_images / self._frame_rate_hz
        while len(self._frames) > 1 and self._frames[1][0] <= time_s:
            self._frames.popleft()
        if not self._frames:
            return False
        last_s = self._frames[-1][0]
        if time_s > last_s:
            return False
        after = self._frames[min(1, len(self._frames) - 1)]
        self._writer.write_image(self._renderer.draw(between(self._frames[0], after, time_s)))
        self.num_images += 1
        return True

    def close(self) -> None:
        """Finish the file."""
        self.path = self._writer.close()

    def discard(self) -> None:
        """Give the unfinished file up."""
        self._writer.discard()


def between(before: tuple[float, Faps], after: tuple[float, Faps], time_s: float) -> Faps:
    """Return the FAPs at a time between two frames; outside, the nearer frame's."""
    (begin_s, begin), (end_s, end) = before, after
    if end_s <= begin_s:
        return begin
    weight = np.float32(np.clip((time_s - begin_s) / (end_s - begin_s), 0.0, 1.0))
    return begin + (end - begin) * weight
