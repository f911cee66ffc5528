"""Videos of somebody who speaks: their pictures and their sound."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ
from kouxing.shared.errors import UserError

MAX_DURATION_S = 1200.0
MAX_SIDE_PX = 960  # larger pictures are made smaller


def read_video(path: Path, take: Callable[[float, NDArray[np.uint8]], None]) -> NDArray[np.float32]:
    """Read a video of any format that FFmpeg knows.

    Parameters
    ----------
    path
        The file.
    take
        Is called with each picture: its time in the sound, seconds, and RGB upright, shape (height,
        width, 3).

    Returns
    -------
    NDArray
        The sound, 16 kHz mono, shape (n,).

    Raises
    ------
    UserError
        If it cannot be read, has no pictures or no sound, or is too long.
    """
    try:
        with av.open(str(path)) as container:
            if not (container.streams.video and container.streams.audio):
                raise UserError(f"{path}: it needs pictures and sound; film it with a microphone")
            return _decode(path, container, take)
    except (av.error.FFmpegError, OSError) as error:
        raise UserError(f"cannot read the video {path}: {error.strerror}") from None


def _decode(
    path: Path,
    container: av.container.InputContainer,
    take: Callable[[float, NDArray[np.uint8]], None],
) -> NDArray[np.float32]:
    video, audio = container.streams.video[0], container.streams.audio[0]
    start_s = float((audio.start_time or 0) * (audio.time_base or 0))
    resampler = av.AudioResampler(format="flt", layout="mono", rate=SAMPLE_RATE_HZ)
    sound = []
    for frame in container.decode(video, audio):
        if isinstance(frame, av.AudioFrame):
            sound += [part.to_ndarray()[0] for part in resampler.resample(frame)]
            continue
        if not isinstance(frame, av.VideoFrame) or frame.time is None:
            continue
        time_s = frame.time - start_s
        if time_s > MAX_DURATION_S:
            raise UserError(f"{path}: it is longer than {MAX_DURATION_S / 60:g} minutes; cut it")
        if time_s >= 0:
            take(time_s, _picture_of(frame))
    sound += [part.to_ndarray()[0] for part in resampler.resample(None)]
    return np.concatenate(sound) if sound else np.zeros(0, np.float32)


def _picture_of(frame: av.VideoFrame) -> NDArray[np.uint8]:
    scale = min(1.0, MAX_SIDE_PX / max(frame.width, frame.height))
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (frame.width, frame.height))
    pixels = frame.to_ndarray(format="rgb24", width=width, height=height)
    return np.rot90(pixels, round(frame.rotation / 90))  # phones store pictures on their side
