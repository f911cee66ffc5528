"""Read videos of speakers: images and audio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ
from kouxing.shared.errors import UserError

MAX_DURATION_S = 1200.0
MAX_SIDE_PX = 960  # larger images are reduced


def read_video(
    path: Path, on_image: Callable[[float, NDArray[np.uint8]], None]
) -> NDArray[np.float32]:
    """Read a video of any format that FFmpeg supports; return the audio, 16 kHz mono, (n,).

    ``on_image`` is called with each image: its time in the audio, seconds, and upright RGB,
    (height, width, 3). Raises UserError if the video cannot be read, has no images or no audio, or
    is too long.
    """
    try:
        with av.open(str(path)) as container:
            if not (container.streams.video and container.streams.audio):
                raise UserError(
                    f"{path}: the video needs images and audio; record it with a microphone"
                )
            return _decode(path, container, on_image)
    except (av.error.FFmpegError, OSError) as error:
        raise UserError(f"cannot read the video {path}: {error.strerror}") from None


def _decode(
    path: Path,
    container: av.container.InputContainer,
    on_image: Callable[[float, NDArray[np.uint8]], None],
) -> NDArray[np.float32]:
    video, audio = container.streams.video[0], container.streams.audio[0]
    start_s = float((audio.start_time or 0) * (audio.time_base or 0))
    resampler = av.AudioResampler(format="flt", layout="mono", rate=SAMPLE_RATE_HZ)
    audio_parts = []
    for frame in container.decode(video, audio):
        if isinstance(frame, av.AudioFrame):
            audio_parts += [part.to_ndarray()[0] for part in resampler.resample(frame)]
            continue
        if not isinstance(frame, av.VideoFrame) or frame.time is None:
            continue
        time_s = frame.time - start_s
        if time_s > MAX_DURATION_S:
            raise UserError(
                f"{path}: the video is longer than {MAX_DURATION_S / 60:g} minutes; cut it"
            )
        if time_s >= 0:
            on_image(time_s, _image_of(frame))
    audio_parts += [part.to_ndarray()[0] for part in resampler.resample(None)]
    return np.concatenate(audio_parts) if audio_parts else np.zeros(0, np.float32)


def _image_of(frame: av.VideoFrame) -> NDArray[np.uint8]:
    scale = min(1.0, MAX_SIDE_PX / max(frame.width, frame.height))
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (frame.width, frame.height))
    pixels = frame.to_ndarray(format="rgb24", width=width, height=height)
    return np.rot90(pixels, round(frame.rotation / 90))  # phones store rotated images
