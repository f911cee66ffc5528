"""Finds faults in the level of a recording, and describes them for the user."""

import numpy as np

from kouxing.shared.audio.phase_cancellation import Samples

_CLIPPED_LEVEL = 0.999
_CLIPPED_FRACTION = 0.01  # warn if a larger fraction of the samples is clipped
_OFFSET_FRACTION = 0.1  # warn above this fraction of the power; usual recordings are below 0.001
_MIN_SAMPLES = 1000  # a shorter recording may be a part of one period, whose mean is not 0
_INAUDIBLE_OFFSET = 0.001  # never warn up to this offset, which silent recordings may have


class LevelCheck:
    """Counts clipped samples, and measures the offset, which is the mean of the samples."""

    def __init__(self) -> None:
        self._num_samples = self._num_clipped = 0
        self._sum = self._squares = 0.0

    def add(self, samples: Samples) -> None:
        """Add the next block of the recording."""
        self._num_samples += samples.size
        self._num_clipped += int(np.count_nonzero(np.abs(samples) >= _CLIPPED_LEVEL))
        self._sum += float(samples.sum(dtype=np.float64))
        self._squares += float(np.square(samples, dtype=np.float64).sum())

    def warnings(self, name: str) -> list[str]:
        """Return a warning for each fault of the recording called ``name``."""
        warnings: list[str] = []
        num_samples = max(1, self._num_samples)
        clipped = self._num_clipped / num_samples
        if clipped > _CLIPPED_FRACTION:
            warnings.append(
                f"{name}: {clipped:.0%} of the samples are clipped; record at a lower level"
            )
        offset = self._sum / num_samples
        if (
            num_samples >= _MIN_SAMPLES
            and abs(offset) > _INAUDIBLE_OFFSET
            and offset**2 > _OFFSET_FRACTION * self._squares / num_samples
        ):
            warnings.append(
                f"{name}: the samples have a constant offset of {offset:.3f}, which hides quiet"
                " speech; subtract it in an audio editor"
            )
        return warnings
