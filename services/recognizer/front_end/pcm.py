"""Conversion of audio bytes to samples and back, and the level and pitch of 20 ms slices."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.pitch import PitchTracker
from kouxing.shared.clock import MEDIA_RATE_HZ, to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Progress

SAMPLE_BYTES = {"s16le": 2, "f32le": 4}
FULL_SCALE = 32768.0
SLICE = 320  # samples at 16 kHz: 20 ms, one FAP frame


def decode_pcm(pcm: bytes, encoding: str, num_channels: int) -> NDArray[np.float32]:
    """Convert bytes to samples, shape (n, channels), clipped to [-1, 1].

    Raises ``UserError`` if the bytes are not a whole number of sample frames, or a sample is not
    finite.
    """
    frame_bytes = SAMPLE_BYTES[encoding] * num_channels
    if len(pcm) % frame_bytes:
        raise UserError(
            f"{len(pcm)} bytes are not a multiple of {frame_bytes} bytes ({encoding}, channels: "
            f"{num_channels}); send the encoding and channels that the session was opened with"
        )
    if encoding == "s16le":
        scaled = np.frombuffer(pcm, "<i2").astype(np.float32) / np.float32(FULL_SCALE)
        return scaled.reshape(-1, num_channels)
    samples = np.frombuffer(pcm, "<f4").astype(np.float32)
    if not np.isfinite(samples).all():
        raise UserError("the chunk was dropped: it contains NaN or infinite samples")
    return np.clip(samples, -1.0, 1.0).reshape(-1, num_channels)


def split_slices(samples: NDArray[np.float32], num_before: int) -> Iterator[NDArray[np.float32]]:
    """Split samples, (n,), at multiples of 20 ms of the stream; ``num_before`` samples precede."""
    begin = 0
    while begin < len(samples):
        end = begin + SLICE - (num_before + begin) % SLICE
        yield samples[begin:end]
        begin = end


def encode_pcm16(samples: NDArray[np.float32]) -> bytes:
    """Convert mono samples in [-1, 1] to little-endian int16 bytes."""
    scaled = np.clip(np.rint(samples * FULL_SCALE), -FULL_SCALE, FULL_SCALE - 1)
    return bytes(scaled.astype("<i2").tobytes())


def level_db(samples: NDArray[np.float32]) -> float:
    """Return the RMS level in decibels relative to full scale; -120 is silence."""
    if len(samples) == 0:
        return -120.0
    exact = samples.astype(np.float64)
    power = float(exact @ exact) / len(exact)
    return max(-120.0, 10.0 * math.log10(power + 1e-12))


def zero_crossing_rate(samples: NDArray[np.float32]) -> float:
    """Return the number of sign changes per sample, 0 to 1.

    Source: Zhang et al. 2021, eq. 2, divided by the number of samples; 0 counts as positive.
    """
    if len(samples) == 0:
        return 0.0
    is_negative = np.signbit(samples)
    return float(np.count_nonzero(is_negative[1:] != is_negative[:-1])) / len(samples)


class SliceMeter:
    """Measures the level and pitch of every 20 ms of audio from media time ``start`` on.

    Times are samples at 16 kHz.
    """

    def __init__(self, start: int = 0) -> None:
        self.media_time = start  # end of the audio so far
        self._start = start
        self._pieces: list[NDArray[np.float32]] = []  # pieces of the incomplete slice
        self._pitch = PitchTracker(start // SLICE)

    def accept_waveform(
        self, samples: NDArray[np.float32]
    ) -> Iterator[tuple[NDArray[np.float32], Progress | None]]:
        """Accept samples, (n,); yield pieces, each with the slice that ends there."""
        for piece in split_slices(samples, self.media_time - self._start):
            self.media_time += len(piece)
            self._pieces.append(piece)
            if (self.media_time - self._start) % SLICE:
                yield piece, None
                continue
            newest = np.concatenate(self._pieces)
            self._pieces.clear()
            yield (
                piece,
                Progress(
                    time_s=to_seconds(self.media_time),
                    level_db=level_db(newest),
                    zero_crossing_rate=zero_crossing_rate(newest),
                    pitch_hz=self._pitch.track(newest),
                ),
            )


def measure_slices(
    samples: NDArray[np.float32],
    with_progress: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> list[Progress]:
    """Measure every 20 ms of a recording, 16 kHz mono, as the live recognizer does.

    ``with_progress`` wraps the loop to show progress.
    """
    meter = SliceMeter()
    return [
        progress
        for start in with_progress(range(0, len(samples), MEDIA_RATE_HZ))
        for _, progress in meter.accept_waveform(samples[start : start + MEDIA_RATE_HZ])
        if progress
    ]
