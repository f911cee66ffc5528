"""Finds syllable endpoints from energy and zero crossings.

Source: Zhang et al. 2021, section 2.2: short-time energy and zero-crossing rate, with two
thresholds each. The states, for slices of 20 ms:

    silence --loud or hissing--> speech --quiet for HANGOVER_S--> silence
                                  |    ^
                             dip  v    |  rise: a segment ends at the dip
                                  falling

======== ================================================================ =====================
symbol   meaning                                                          here
======== ================================================================ =====================
Q_n      short-time energy, as the level in dB of full scale              ``level_db``
Z_n      zero crossings as a fraction of the samples, 0 to 1              ``zero_crossing_rate``
======== ================================================================ =====================

Deviations: The paper detects short gaps between words. Real syllables seldom have gaps, so a
segment also ends at a dip of the *sonority*, which is the level minus a penalty for zero crossings
above their low threshold. Unvoiced consonants are therefore also dips. The level thresholds are
above the noise floor, which is the quietest slice of the last 3 s (as in minimum statistics:
Martin, "Noise power spectral density estimation based on optimal smoothing and minimum statistics",
2001). They are proportional to the range of recent levels, because speech rises less above the
floor in noise.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from kouxing.shared.phones.events import Progress

SLICE_S = 0.02

# Tuned on the training split for boundaries found within 50 ms; no value is critical.
HIGH_FRACTION = 0.4  # high threshold, relative to the range of recent levels
MIN_HIGH_DB = 4.0  # more than the variation of steady noise
LOW_FRACTION = 0.5  # low threshold, relative to the high threshold
HIGH_ZERO_CROSSINGS, LOW_ZERO_CROSSINGS = 0.3, 0.1
HANGOVER_S = 0.06
DIP_DB = 3.0  # fall and rise that separate two segments
MIN_SEGMENT_S = 0.1
_HISS_DB = 30.0  # sonority penalty for a zero-crossing rate of 1
_DESCENT = 0.5  # a segment ends at this fraction of the height between dip and peak
_ONSET_S = 0.1  # speech may start this long before it is loud
_RANGE_SLICES = 150  # 3 s; in this time speech has gaps that show the noise floor
_MIN_LEVEL_DB = -75.0
_INITIAL_LEVEL_DB = -30.0
_MEMORY_SLICES = 50
_MAX_GAP_S = 0.1


@dataclass(frozen=True, slots=True)
class EnergySegment:
    """A segment of speech, about as long as a syllable."""

    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class _AveragedSlice:
    """A slice, averaged with the previous slice."""

    end_s: float
    level_db: float
    crossings: float

    @property
    def sonority_db(self) -> float:
        return self.level_db - _HISS_DB * max(self.crossings - LOW_ZERO_CROSSINGS, 0.0)


class SyllableSegmenter:
    """Divides the speech of one stream into segments, slice by slice."""

    def __init__(self) -> None:
        self.start_s: float | None = None  # start of the current segment; None in silence
        self._levels_db = deque([_INITIAL_LEVEL_DB] * _RANGE_SLICES, maxlen=_RANGE_SLICES)
        self._before: Progress | None = None
        self._recent: deque[_AveragedSlice] = deque(maxlen=_MEMORY_SLICES)
        self._loud_until_s = 0.0
        self._peak: _AveragedSlice | None = None  # in the current segment
        self._dip: _AveragedSlice | None = None  # after the peak; None until sonority falls

    def add_slice(self, new: Progress) -> list[EnergySegment]:
        """Add the next slice; return completed segments. A time gap ends a segment."""
        segments = []
        if self._before is not None and new.time_s - self._before.time_s > _MAX_GAP_S:
            segments = self.finish()
        now = _average(self._before or new, new)
        self._before = new
        self._recent.append(now)
        low_db, high_db = self._thresholds(now.level_db)
        is_low = now.level_db > low_db
        if self.start_s is None:
            is_high = now.level_db > high_db
            if is_high or (is_low and now.crossings > HIGH_ZERO_CROSSINGS):
                self._start(low_db)
            return segments
        if is_low:
            self._loud_until_s = now.end_s
        elif now.end_s - self._loud_until_s >= HANGOVER_S - 0.5 * SLICE_S:
            return segments + self._end()
        return segments + self._follow_sonority(now)

    def finish(self) -> list[EnergySegment]:
        """End the sound; return the current segment, if any."""
        self._before = None
        self._recent.clear()
        return self._end()

    def _thresholds(self, level_db: float) -> tuple[float, float]:
        """Return the low and the high threshold of the level, dB of full scale."""
        self._levels_db.append(max(level_db, _MIN_LEVEL_DB))
        floor_db = min(self._levels_db)
        high_db = max(HIGH_FRACTION * (max(self._levels_db) - floor_db), MIN_HIGH_DB)
        return floor_db + LOW_FRACTION * high_db, floor_db + high_db

    def _start(self, low_db: float) -> None:
        """Start where the level passed the low threshold, at most ``_ONSET_S`` ago."""
        now = self._recent[-1]
        first = now
        for earlier in reversed(self._recent):
            if earlier.level_db <= low_db or earlier.end_s < now.end_s - _ONSET_S:
                break
            first = earlier
        self.start_s = max(first.end_s - SLICE_S, 0.0)
        self._loud_until_s = now.end_s
        self._peak, self._dip = now, None

    def _end(self) -> list[EnergySegment]:
        start_s, self.start_s = self.start_s, None
        if start_s is None or self._loud_until_s - start_s < 0.5 * MIN_SEGMENT_S:
            return []
        return [EnergySegment(start_s, self._loud_until_s)]

    def _follow_sonority(self, now: _AveragedSlice) -> list[EnergySegment]:
        """Track peak and dip; split between them when the sonority rises again."""
        peak, dip = self._peak, self._dip
        if peak is None or (dip is None and now.sonority_db > peak.sonority_db):
            self._peak = now
        elif dip is None:
            if now.sonority_db < peak.sonority_db - DIP_DB:
                self._dip = now
        elif now.sonority_db < dip.sonority_db:
            self._dip = now
        elif now.sonority_db > dip.sonority_db + DIP_DB:
            self._peak, self._dip = now, None
            return self._split(peak, dip)
        return []

    def _split(self, peak: _AveragedSlice, dip: _AveragedSlice) -> list[EnergySegment]:
        """Split on the way down from a peak to a dip."""
        edge_db = dip.sonority_db + _DESCENT * (peak.sonority_db - dip.sonority_db)
        descent = [slice_ for slice_ in self._recent if peak.end_s < slice_.end_s <= dip.end_s]
        split_s = dip.end_s
        for slice_ in reversed(descent):
            if slice_.sonority_db > edge_db:
                break
            split_s = slice_.end_s - SLICE_S
        if self.start_s is None or split_s - self.start_s < MIN_SEGMENT_S:
            return []
        segment = EnergySegment(self.start_s, split_s)
        self.start_s = split_s
        return [segment]


def segment_speech(slices: Iterable[Progress]) -> list[EnergySegment]:
    """Divide a whole recording into segments."""
    segmenter = SyllableSegmenter()
    segments = [segment for slice_ in slices for segment in segmenter.add_slice(slice_)]
    return segments + segmenter.finish()


def _average(before: Progress, now: Progress) -> _AveragedSlice:
    return _AveragedSlice(
        now.time_s,
        0.5 * (before.level_db + now.level_db),
        0.5 * (before.zero_crossing_rate + now.zero_crossing_rate),
    )
