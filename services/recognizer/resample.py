"""Any microphone's sound as the recognizer's: 16 kHz, one channel, 32-bit float.

Uses the SoX resampler (soxr): linear phase, flat to 0.91 of the band. Its output does not depend
on how the input is cut into chunks. It looks ahead by half its filter: the delay is about 10 ms
from 44.1 or 48 kHz and 20 ms from 8 kHz; nothing at 16 kHz, where the samples pass through.
"""

from __future__ import annotations

import numpy as np
import soxr
from numpy.typing import NDArray

from services.recognizer.features import SAMPLE_RATE_HZ
from shared.errors import UserError

LOWEST_RATE_HZ = 8_000
HIGHEST_RATE_HZ = 48_000


class Resampler:
    """Streaming resampler to 16 kHz mono.

    Parameters
    ----------
    sample_rate_hz
        Rate of the input, 8000 to 48000.
    num_channels
        Channels of the input; they are averaged.

    Raises
    ------
    UserError
        If the rate or the number of channels is out of range.
    """

    def __init__(self, sample_rate_hz: int, num_channels: int = 1) -> None:
        if not LOWEST_RATE_HZ <= sample_rate_hz <= HIGHEST_RATE_HZ:
            raise UserError(
                f"sample rate {sample_rate_hz} Hz is out of range; "
                f"give {LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ} Hz"
            )
        if not 1 <= num_channels <= 8:
            raise UserError(f"{num_channels} channels are out of range; give 1 to 8")
        self._rate_hz = sample_rate_hz
        self._num_channels = num_channels
        self.reset()

    def reset(self) -> None:
        """Start a new stream."""
        self._stream = (
            None
            if self._rate_hz == SAMPLE_RATE_HZ
            else soxr.ResampleStream(self._rate_hz, SAMPLE_RATE_HZ, 1, dtype="float32")
        )

    def accept_waveform(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take samples of shape (n,) or (n, channels); return those ready at 16 kHz, (m,).

        Raises
        ------
        UserError
            If the shape does not fit the channels or a sample is no number.
        """
        return self._resample(self._mono(samples), last=False)

    def finish(self) -> NDArray[np.float32]:
        """Return the samples still owed at the end of the stream."""
        return self._resample(np.empty(0, dtype=np.float32), last=True)

    def _resample(self, mono: NDArray[np.float32], *, last: bool) -> NDArray[np.float32]:
        if self._stream is None:
            return mono
        resampled: NDArray[np.float32] = self._stream.resample_chunk(mono, last=last)
        return resampled

    def _mono(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        expected = (
            (len(samples),) if self._num_channels == 1 else (len(samples), self._num_channels)
        )
        if samples.shape not in (expected, (len(samples), self._num_channels)):
            raise UserError(f"samples have shape {samples.shape}; expected {expected}")
        if not np.isfinite(samples).all():
            raise UserError("samples hold values that are no numbers; send values in [-1, 1]")
        mono = samples.reshape(len(samples), self._num_channels)
        clipped: NDArray[np.float32] = np.clip(mono.mean(axis=1), -1.0, 1.0).astype(np.float32)
        return clipped


def to_16_khz(samples: NDArray[np.float32], sample_rate_hz: int) -> NDArray[np.float32]:
    """Resample a whole recording of shape (n,) or (n, channels) to 16 kHz mono."""
    num_channels = 1 if samples.ndim == 1 else samples.shape[1]
    resampler = Resampler(sample_rate_hz, num_channels)
    return np.concatenate([resampler.accept_waveform(samples), resampler.finish()])
