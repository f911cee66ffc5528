"""The format of raw samples, and the raw samples in a WAV file."""

import io
from typing import Any, NamedTuple

import av
import numpy as np

from kouxing.shared.audio.audio_formats import MIN_UNKNOWN_BYTES, codec_of_padded_wav

_WAV_TYPES = {"pcm_s16le": "<i2", "pcm_f32le": "<f4"}


class RawFormat(NamedTuple):
    """The format of raw samples."""

    sample_rate_hz: int = 16_000
    num_channels: int = 1
    dtype: np.dtype[Any] = np.dtype("<i2")

    @property
    def bytes_per_s(self) -> int:
        """Number of bytes per second of audio."""
        return self.dtype.itemsize * self.num_channels * self.sample_rate_hz


class WavPcm(NamedTuple):
    """The samples in a WAV file."""

    format: RawFormat
    offset: int  # position of the first sample, bytes
    num_bytes: int | None  # None: until the end of the file


def pcm_of_wav(begin: bytes) -> WavPcm | None:
    """Find the samples of a WAV stream, if they are 16-bit integers or 32-bit floats.

    None for other encodings and for more than two channels.
    """
    if begin[:4] != b"RIFF" or begin[8:12] != b"WAVE" or codec_of_padded_wav(begin):
        return None
    try:
        with av.open(io.BytesIO(begin), mode="r", format="wav") as container:
            codec: Any = container.streams.audio[0].codec_context
            if codec is None:
                return None
            offset = next(container.demux()).pos
    except (av.error.FFmpegError, ValueError, IndexError, StopIteration):
        return None
    dtype = _WAV_TYPES.get(codec.name)
    if (
        dtype is None
        or codec.channels not in (1, 2)
        or offset is None
        or begin[offset - 8 : offset - 4] != b"data"
    ):
        return None
    stated = int.from_bytes(begin[offset - 4 : offset], "little")
    is_known = 0 < stated < MIN_UNKNOWN_BYTES
    raw = RawFormat(codec.sample_rate, codec.channels, np.dtype(dtype))
    return WavPcm(raw, offset, stated if is_known else None)
