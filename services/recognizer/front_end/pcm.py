"""Conversion of audio bytes to samples and back, and the level and pitch of 20 ms slices."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.pitch import PitchTracker
from kouxing.shared.clock import MEDIA_RATE_HZ, to_seconds
from kouxing.shared.phones.events import Progress

SAMPLE_BYTES = {"s16le": 2, "f32le": 4}
FULL_SCALE = 32768.0
SLICE = 320  # samples at 16 kHz: 20 ms, one FAP frame


class BadAudio(ValueError):
    """Bytes that are not audio in the session's encoding."""


def samples_of(pcm: bytes, encoding: str, num_channels: int) -> NDArray[np.float32]:
    """Convert bytes to samples, shape (n, channels), clipped to [-1, 1].

    Raises ``BadAudio`` if the bytes are not a whole number of sample frames, or a sample is not
    finite.
    """
    frame_bytes = SAMPLE_BYTES[encoding] * num_channels
    if len(pcm) % frame_bytes:
        raise BadAudio(
            f"a length of {len(pcm)} B is not a multiple of {frame_bytes} B ({encoding}, channels: "
            f"{num_channels}); send the encoding and channels that the session was opened with"
        )
    if encoding == "s16le":
        scaled = np.frombuffer(pcm, "<i2").astype(np.float32) / np.float32(FULL_SCALE)
        return scaled.reshape(-1, num_channels)
    samples = np.frombuffer(pcm, "<f4").astype(np.float32)
    if not np.isfinite(samples).all():
        raise BadAudio("the chunk was dropped: it contains NaN or infinite samples")
    return np.clip(samples, -1.0, 1.0).reshape(-1, num_channels)


def slices(samples: NDArray[np.float32], num_before: int) -> Iterator[NDArray[np.float32]]:
    """Cut samples, (n,), at multiples of 20 ms of the stream, of which ``num_before`` are past."""
    begin = 0
    while begin < len(samples):
        end = begin + SLICE - (num_before + begin) % SLICE
        yield samples[begin:end]
        begin = end


def pcm16_of(samples: NDArray[np.float32]) -> bytes:
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
    return float(np.count_nonzero(np.diff(np.signbit(samples)))) / len(samples)


def progress_at(media_time: int, newest: NDArray[np.float32], pitch: PitchTracker) -> Progress:
    """Measure the newest slice, shape (320,), which ends at ``media_time``."""
    return Progress(
        time_s=to_seconds(media_time),
        level_db=level_db(newest),
        zero_crossing_rate=zero_crossing_rate(newest),
        pitch_hz=pitch.track(newest),
    )


def progress_of(samples: NDArray[np.float32], silence_s: float = 0.0) -> list[Progress]:
    """Measure every 20 ms of a recording, 16 kHz mono, as the live recognizer does.

    A silence of ``silence_s`` follows the recording.
    """
    pitch = PitchTracker()
    num_samples = len(samples) + round(silence_s * MEDIA_RATE_HZ)
    return [
        progress_at(end, _extended(samples[end - SLICE : end]), pitch)
        for end in range(SLICE, num_samples + 1, SLICE)
    ]


def _extended(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return samples, (n,), with silence up to the length of a slice."""
    num_missing = SLICE - len(samples)
    return np.pad(samples, (0, num_missing)) if num_missing else samples
