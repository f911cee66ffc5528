"""Write MP4 files: H.264 pictures and AAC sound in sync.

Picture ``n`` is shown at ``n / frame_rate_hz``, sound sample ``n`` is heard at
``n / sample_rate_hz``, both from the file's start.
"""

from __future__ import annotations

import contextlib
import errno
import secrets
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from shared.errors import UserError

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

SAMPLE_RATES_HZ = (8000, 11025, 12000, 16000, 22050, 24000, 32000, 44100, 48000)  # of AAC
QUALITY = 18  # constant rate factor of x264; 18 is visually lossless


class VideoWriter:
    """An MP4 file that appears under its name when it is complete.

    Parameters
    ----------
    path
        File to write; an existing one is replaced on ``close``.
    width_px, height_px
        Even numbers.
    frame_rate_hz
        Pictures a second.
    sample_rate_hz
        One of ``SAMPLE_RATES_HZ``.

    Raises
    ------
    UserError
        If the file cannot be written or a value does not fit.
    """

    def __init__(
        self,
        path: str | Path,
        width_px: int,
        height_px: int,
        frame_rate_hz: float,
        sample_rate_hz: int,
    ) -> None:
        if width_px < 2 or height_px < 2 or width_px % 2 or height_px % 2:
            raise UserError(
                f"a video of {width_px} x {height_px} pixels; give even, positive sizes"
            )
        if not frame_rate_hz > 0:
            raise UserError(f"a frame rate of {frame_rate_hz} Hz; give a positive one")
        if sample_rate_hz not in SAMPLE_RATES_HZ:
            rates = ", ".join(str(rate) for rate in SAMPLE_RATES_HZ)
            raise UserError(f"AAC has no sample rate of {sample_rate_hz} Hz; give one of {rates}")
        self._path = Path(path)
        self._shape = (height_px, width_px, 3)
        self._sample_rate_hz = sample_rate_hz
        # Another process may be writing a video of the same name.
        self._unfinished = self._path.with_name(f".{self._path.name}.{secrets.token_hex(4)}.part")
        self._num_images = self._num_samples = 0
        try:
            if self._path.is_dir():
                raise IsADirectoryError(errno.EISDIR, "it is a folder")
            self._unfinished.touch()  # FFmpeg would open it only at the first packet
            self._container = av.open(
                str(self._unfinished), "w", format="mp4", options={"movflags": "faststart"}
            )
        except OSError as error:
            raise self._unwritable(error) from error
        rate = Fraction(frame_rate_hz).limit_denominator(1001)
        self._video = self._container.add_stream(
            "libx264", rate=rate, options={"crf": str(QUALITY), "preset": "veryfast"}
        )
        self._video.width, self._video.height = width_px, height_px
        self._video.pix_fmt = "yuv420p"
        self._video.codec_context.time_base = 1 / rate
        self._video.codec_context.thread_count = 1
        self._sound = self._container.add_stream("aac", rate=sample_rate_hz, layout="mono")

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self.discard()

    def write_image(self, image: UInt8) -> None:
        """Append a picture (H, W, 3), sRGB."""
        if image.shape != self._shape:
            raise ValueError(f"expected a picture of shape {self._shape}, got {image.shape}")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts = self._num_images
        frame.time_base = self._video.codec_context.time_base
        self._num_images += 1
        self._mux(self._video.encode(frame))

    def write_sound(self, samples: Float32) -> None:
        """Append mono sound (N,), -1 to 1."""
        if not len(samples):
            return
        block = np.ascontiguousarray(samples, dtype=np.float32)[None, :]
        frame = av.AudioFrame.from_ndarray(block, format="fltp", layout="mono")
        frame.sample_rate = self._sample_rate_hz
        frame.pts = self._num_samples
        frame.time_base = Fraction(1, self._sample_rate_hz)
        self._num_samples += len(samples)
        self._mux(self._sound.encode(frame))

    def _mux(self, packets: list[Any]) -> None:
        try:
            self._container.mux(packets)
        except OSError as error:
            self.discard()
            raise self._unwritable(error) from error

    def close(self) -> None:
        """Finish the file and give it its name."""
        self._mux(self._video.encode(None))
        if self._num_samples:
            self._mux(self._sound.encode(None))
        try:
            self._container.close()
            self._unfinished.replace(self._path)
        except OSError as error:
            self._unfinished.unlink(missing_ok=True)
            raise self._unwritable(error) from error

    def discard(self) -> None:
        """Give the unfinished file up."""
        with contextlib.suppress(OSError):
            self._container.close()
        self._unfinished.unlink(missing_ok=True)

    def _unwritable(self, error: OSError) -> UserError:
        return UserError(
            f"{self._path} cannot be written ({error.strerror or error}); give a path in a folder"
            " that exists and may be written"
        )
