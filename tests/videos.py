"""A small video with sound."""

from pathlib import Path

import numpy as np

from kouxing.services.driver.video.video_writer import VideoWriter
from kouxing.shared.clock import MEDIA_RATE_HZ

DURATION_S = 0.25
_RATE_HZ = 20.0


def write_video(path: Path, *, has_sound: bool = True) -> None:
    """Write 0.25 s of gray with a tone: H.264 and AAC in .mp4."""
    time_s = np.arange(round(DURATION_S * MEDIA_RATE_HZ)) / MEDIA_RATE_HZ
    with VideoWriter(path, 64, 48, _RATE_HZ, MEDIA_RATE_HZ if has_sound else None) as video:
        for _ in range(round(DURATION_S * _RATE_HZ)):
            video.write_image(np.full((48, 64, 3), 128, np.uint8))
        video.write_audio((0.1 * np.sin(2 * np.pi * 440.0 * time_s)).astype(np.float32))
