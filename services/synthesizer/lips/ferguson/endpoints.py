"""Endpoints: where the syllables of a sound begin and end, by energy and zero crossings.

Source: Zhang et al. 2021, section 2.2: short-time energy and zero-crossing rate, with two
thresholds each. The states, for slices of 20 ms:

    silence --loud, or hissing--> speech --quiet for HANGOVER_S--> silence
                                  |    ^
                             dip  v    |  rise: a piece ends at the dip, the next begins
                                  falling

======== ================================================================ =====================
symbol   meaning                                                          here
======== ================================================================ =====================
Q_n      short-time energy, as the level in dB of full scale              ``level_db``
Z_n      zero crossings, each as a share of the samples, 0 to 1           ``zero_crossing_rate``
======== ================================================================ =====================

Deviations: the paper finds the short gaps between words. Real syllables seldom have one, so a piece
also ends at a dip of the *sonority*: the level, less what zero crossings above their low threshold
take away, so that an unvoiced consonant is a dip too. The thresholds of the level stand above the
noise floor, the quietest slice of the last 3 s (as in minimum statistics: Martin, "Noise power
spectral density estimation based on optimal smoothing and minimum statistics", 2001), in proportion
to the range from there to the loudest: in noise, speech rises less above the floor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from kouxing.shared.phones.events import Progress

SLICE_S = 0.02

# Chosen on recordings of the training split, by boundaries found within 50 ms; none of these
# numbers matters much.
HIGH_SHARE = 0.4  # height of the high threshold, as a share of the range of recent levels
MIN_HIGH_DB = 4.0  # more than steady noise varies
LOW_SHARE = 0.5  # height of the low threshold, as a share of the high one's
HIGH_ZERO_CROSSINGS, LOW_ZERO_CROSSINGS = 0.3, 0.1
HANGOVER_S = 0.06
DIP_DB = 3.0  # fall and rise that part two pieces
MIN_PIECE_S = 0.1
_HISS_DB = 30.0  # of sonority that a slice loses for each zero crossing a sample
_DESCENT = 0.5  # a piece ends this far above the dip, relative to its peak
_ONSET_S = 0.1  # by which speech may begin before it is loud
_RANGE_SLICES = 150  # 3 s, in which speech has gaps that show the noise floor
_LOWEST_LEVEL_DB = -75.0
_FIRST_LEVEL_DB = -30.0  # before anything is known
_MEMORY_SLICES = 50
_MAX_GAP_S = 0.1


@dataclass(frozen=True, slots=True)
class Piece:
    """A stretch of speech about as long as a syllable."""

    start_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class _Loudness:
    """A slice, averaged with the one before it."""

    end_s: float
    level_db: float
    crossings: float

    @property
    def sonority_db(self) -> float:
        return self.level_db - _HISS_DB * max(self.crossings - LOW_ZERO_CROSSINGS, 0.0)


class SyllableCutter:
    """Cuts the speech of one stream into pieces, slice by slice.

    Attributes
    ----------
    start_s : float or None
        When the piece under way began, seconds; None in silence.
    """

    def __init__(self) -> None:
        self.start_s: float | None = None
        self._levels_db = deque([_FIRST_LEVEL_DB] * _RANGE_SLICES, maxlen=_RANGE_SLICES)
        self._before: Progress | None = None
        self._recent: deque[_Loudness] = deque(maxlen=_MEMORY_SLICES)
        self._loud_until_s = 0.0
        self._peak: _Loudness | None = None  # since the piece began
        self._dip: _Loudness | None = None  # after it; None: sonority has not fallen yet

    def accept(self, one: Progress) -> list[Piece]:
        """Take the next slice; return the pieces that are known to have ended.

        A hole in time ends the piece before it.
        """
        pieces = []
        if self._before is not None and one.time_s - self._before.time_s > _MAX_GAP_S:
            pieces = self.finish()
        now = _average(self._before or one, one)
        self._before = one
        self._recent.append(now)
        low_db, high_db = self._thresholds(now.level_db)
        is_low = now.level_db > low_db
        if self.start_s is None:
            is_high = now.level_db > high_db
            if is_high or (is_low and now.crossings > HIGH_ZERO_CROSSINGS):
                self._begin(low_db)
            return pieces
        if is_low:
            self._loud_until_s = now.end_s
        elif now.end_s - self._loud_until_s >= HANGOVER_S - 0.5 * SLICE_S:
            return pieces + self._end()
        return pieces + self._follow_sonority(now)

    def finish(self) -> list[Piece]:
        """End the sound; return the piece under way, if there is one."""
        self._before = None
        self._recent.clear()
        return self._end()

    def _thresholds(self, level_db: float) -> tuple[float, float]:
        """Return the low and the high threshold of the level, dB of full scale."""
        self._levels_db.append(max(level_db, _LOWEST_LEVEL_DB))
        floor_db = min(self._levels_db)
        high_db = max(HIGH_SHARE * (max(self._levels_db) - floor_db), MIN_HIGH_DB)
        return floor_db + LOW_SHARE * high_db, floor_db + high_db

    def _begin(self, low_db: float) -> None:
        """Begin where the low threshold was passed, at most ``_ONSET_S`` before."""
        now = self._recent[-1]
        begin = now
        for earlier in reversed(self._recent):
            if earlier.level_db <= low_db or earlier.end_s < now.end_s - _ONSET_S:
                break
            begin = earlier
        self.start_s = max(begin.end_s - SLICE_S, 0.0)
        self._loud_until_s = now.end_s
        self._peak, self._dip = now, None

    def _end(self) -> list[Piece]:
        start_s, self.start_s = self.start_s, None
        if start_s is None or self._loud_until_s - start_s < 0.5 * MIN_PIECE_S:
            return []
        return [Piece(start_s, self._loud_until_s)]

    def _follow_sonority(self, now: _Loudness) -> list[Piece]:
        """Follow peak and dip; cut between them once the sonority has risen again."""
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
            return self._cut(peak, dip)
        return []

    def _cut(self, peak: _Loudness, dip: _Loudness) -> list[Piece]:
        """Cut on the way down from a peak to a dip."""
        edge_db = dip.sonority_db + _DESCENT * (peak.sonority_db - dip.sonority_db)
        descent = [one for one in self._recent if peak.end_s < one.end_s <= dip.end_s]
        cut_s = dip.end_s
        for one in reversed(descent):
            if one.sonority_db > edge_db:
                break
            cut_s = one.end_s - SLICE_S
        if self.start_s is None or cut_s - self.start_s < MIN_PIECE_S:
            return []
        piece = Piece(self.start_s, cut_s)
        self.start_s = cut_s
        return [piece]


def pieces_of(slices: Iterable[Progress]) -> list[Piece]:
    """Cut a whole sound into pieces."""
    cutter = SyllableCutter()
    pieces = [piece for one in slices for piece in cutter.accept(one)]
    return pieces + cutter.finish()


def _average(before: Progress, one: Progress) -> _Loudness:
    return _Loudness(
        one.time_s,
        0.5 * (before.level_db + one.level_db),
        0.5 * (before.zero_crossing_rate + one.zero_crossing_rate),
    )
