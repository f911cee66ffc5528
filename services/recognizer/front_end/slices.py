"""Slices of 20 ms, and their level and pitch."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from kouxing.services.recognizer.front_end.pitch import PitchTracker
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ, to_seconds
from kouxing.shared.phones.events import Progress

SLICE_SAMPLES = 320  # at 16 kHz: 20 ms, one FAP frame


def split_slices(samples: Floats, num_before: int) -> Iterator[Floats]:
    """Split samples, (n,), at multiples of 20 ms of the stream; ``num_before`` samples precede."""
    begin = 0
    while begin < len(samples):
        end = begin + SLICE_SAMPLES - (num_before + begin) % SLICE_SAMPLES
        yield samples[begin:end]
        begin = end


def level_db(samples: Floats) -> float:
    """Return the RMS level in decibels relative to full scale; -120 is silence."""
    if len(samples) == 0:
        return -120.0
    exact = samples.astype(np.float64)
    power = float(exact @ exact) / len(exact)
    return max(-120.0, 10.0 * math.log10(power + 1e-12))


def zero_crossing_rate(samples: Floats) -> float:
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
        self._chunks: list[Floats] = []  # audio of the incomplete slice
        self._pitch = PitchTracker(start // SLICE_SAMPLES)

    def accept_waveform(self, samples: Floats) -> Iterator[tuple[Floats, Progress | None]]:
        """Accept samples, (n,); yield chunks, each with the slice that ends there."""
        for chunk in split_slices(samples, self.media_time - self._start):
            self.media_time += len(chunk)
            self._chunks.append(chunk)
            if (self.media_time - self._start) % SLICE_SAMPLES:
                yield chunk, None
                continue
            newest = np.concatenate(self._chunks)
            self._chunks.clear()
            yield (
                chunk,
                Progress(
                    time_s=to_seconds(self.media_time),
                    level_db=level_db(newest),
                    zero_crossing_rate=zero_crossing_rate(newest),
                    pitch_hz=self._pitch.track(newest),
                ),
            )


def measure_slices(
    samples: Floats, with_progress: Callable[[Sequence[int]], Iterable[int]] = iter
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
