"""The audio of media files in any format that FFmpeg reads: m4a, mp4, webm, mkv, mov."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from kouxing.shared.errors import UserError

_MAX_STREAMS = 64
# Read only the file itself: no network, and no files that a playlist names.
_OPTIONS = {"protocol_whitelist": "file"}


@dataclass(frozen=True, slots=True)
class MediaSound:
    """The first audio track of a media file."""

    sample_rate_hz: int
    num_channels: int
    duration_s: float | None  # as the file states it
    blocks: Iterator[NDArray[np.float32]]  # (n, channels), until the end


def open_media(path: Path, max_rate_hz: int, max_channels: int) -> MediaSound:
    """Open the audio of a media file, with a limited rate and 1 or 2 channels.

    Raises
    ------
    UserError
        If FFmpeg cannot read the file or it has no audio; while reading, if the file is damaged.
    """
    try:
        container = av.open(path, options=_OPTIONS)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise UserError(
            f"{path}: cannot read audio from this file ({_reason(error)}); use wav, flac, mp3, "
            "m4a, mp4, webm or ogg"
        ) from None
    if not container.streams.audio or len(container.streams) > _MAX_STREAMS:
        container.close()
        raise UserError(f"{path}: the file has no audio")
    stream = container.streams.audio[0]
    rate_hz = min(stream.rate, max_rate_hz)
    num_channels = min(max_channels, stream.channels)
    duration_s = None
    if stream.duration is not None and stream.time_base is not None:
        duration_s = float(stream.duration * stream.time_base)
    elif container.duration is not None:
        duration_s = float(Fraction(container.duration, av.time_base))
    resampler = av.AudioResampler(
        format="flt", layout="stereo" if num_channels == 2 else "mono", rate=rate_hz
    )
    return MediaSound(
        rate_hz, num_channels, duration_s, _blocks(path, container, resampler, num_channels)
    )


def check_video(path: Path) -> None:
    """Raise ``UserError`` if a file is not a video with audio."""
    try:
        with av.open(path, options=_OPTIONS) as container:
            has_both = bool(container.streams.video and container.streams.audio)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise UserError(f"{path}: cannot read this as a video ({_reason(error)})") from None
    if not has_both:
        raise UserError(f"{path}: the video must have pictures and audio")


def _blocks(
    path: Path,
    container: av.container.InputContainer,
    resampler: av.AudioResampler,
    num_channels: int,
) -> Iterator[NDArray[np.float32]]:
    num_read = 0
    with container:
        frames = container.decode(audio=0)
        while True:
            try:
                frame = next(frames, None)
                parts = resampler.resample(frame)
            except (av.error.FFmpegError, ValueError) as error:
                place_s = num_read / resampler.rate
                raise UserError(f"{path}: damaged at {place_s:.2f} s: {_reason(error)}") from None
            for part in parts:
                num_read += part.samples
                yield part.to_ndarray().astype(np.float32, copy=False).reshape(-1, num_channels)
            if frame is None:
                return


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
