"""Measures of how well two curves of a mouth agree: pure functions of arrays.

*Made* lips come from a lip model, *real* lips were tracked. Both are sampled at the same times
unless stated otherwise: ``time_s`` in seconds, curves of shape (num_frames,), NaN where a real
mouth was not measured. Openings are in FAP units. All results are sums or counts that can be added,
so that the figures of a group of clips are those of all their frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CLOSURE_WINDOW_S = 0.04
OPENING_WINDOW_S = 0.3  # a made opening further away belongs to another real one
HALF_OPEN = 60.0  # FAP units: neither closed nor open
_CLOSED, _OPEN = 20.0, 100.0  # opening of made lips in FAP units: 0.6 and 3 mm on a face
_CLOSED_SHARE = 0.1  # of a real mouth's range
# A contact counts only near lips that are open by this share of the range. Else it is a pause.
_OPEN_SHARE, _OPEN_WINDOW_S = 0.5, 0.2
_RISE_FROM, _RISE_TO = 0.1, 0.3  # shares of a mouth's range
_NO_POWER = 1e-12  # per frame: what filters leave of a constant curve
_ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class Sums:
    """Base of results that can be added field by field."""

    def __add__(self, other: Self) -> Self:
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return type(self)(*(ours + theirs for ours, theirs in pairs))


@dataclass(frozen=True, slots=True)
class Moments(Sums):
    """Second moments of a made and a real curve, after removal of each clip's mean."""

    num_frames: int = 0
    products: float = 0.0
    made_power: float = 0.0
    real_power: float = 0.0

    @property
    def correlation(self) -> float | None:
        """Pearson correlation; None if a curve is constant."""
        if min(self.made_power, self.real_power) <= _NO_POWER * self.num_frames:
            return None
        return self.products / float(np.sqrt(self.made_power * self.real_power))

    @property
    def rmse(self) -> float | None:
        """Root mean square error; None without frames."""
        if not self.num_frames:
            return None
        squares = self.made_power + self.real_power - 2.0 * self.products
        return float(np.sqrt(max(squares, 0.0) / self.num_frames))


@dataclass(frozen=True, slots=True)
class Detections(Sums):
    """Counts of real events, of those reproduced, of made events, and of those that are true."""

    real: int = 0
    met: int = 0
    made: int = 0
    true: int = 0

    @property
    def recall(self) -> float | None:
        """Share of the real events that are reproduced."""
        return self.met / self.real if self.real else None

    @property
    def precision(self) -> float | None:
        """Share of the made events that are true."""
        return self.true / self.made if self.made else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of recall and precision; 0 if no real event is reproduced."""
        if self.recall is None:
            return None
        precision = self.precision or 0.0
        return 2.0 * self.recall * precision / (self.recall + precision or 1.0)


def moments(made: Array, real: Array) -> Moments:
    """Compare two curves of a clip."""
    if not len(made):
        return Moments()
    made, real = made - made.mean(), real - real.mean()
    return Moments(len(made), float(made @ real), float(made @ made), float(real @ real))


def rms_jerk(curves: Sequence[Array], rate_hz: float) -> float | None:
    """Root mean square of the third derivative of curves; None if none has four frames."""
    jerks = np.concatenate([np.zeros(0), *(np.diff(curve, n=3) for curve in curves)]) * rate_hz**3
    return float(np.sqrt(np.mean(jerks**2))) if len(jerks) else None


def real_closed(time_s: Array, opening: Array) -> Array:
    """Return the times of all frames in which real lips are closed, seconds."""
    return time_s[_is_closed(opening)]


def real_closures(time_s: Array, opening: Array) -> Array:
    """Return when real lips close, seconds: minima of closed lips near an opening."""
    before, here, after = opening[:-2], opening[1:-1], opening[2:]
    is_minimum = (here <= before) & (here < after) & _is_closed(opening)[1:-1]
    moments_s: Array = time_s[1:-1][is_minimum]
    if not len(moments_s):
        return moments_s
    low, high = np.nanpercentile(opening, [1, 99])
    opened_s = time_s[opening > low + _OPEN_SHARE * (high - low)]
    return np.asarray(moments_s[is_near(moments_s, opened_s, _OPEN_WINDOW_S)])


def _is_closed(opening: Array) -> Mask:
    """Whether the opening of a real mouth is in the lowest tenth of its range."""
    if np.isnan(opening).all():
        return np.zeros(len(opening), dtype=bool)
    low, high = np.nanpercentile(opening, [1, 99])
    is_closed: Mask = opening < low + _CLOSED_SHARE * (high - low)
    return is_closed


def is_closed_at(moments_s: Array, time_s: Array, opening: Array) -> Mask:
    """Whether made lips close within 40 ms of each moment and are open within 0.2 s."""
    near: Mask = is_near(moments_s, time_s[opening < _CLOSED], CLOSURE_WINDOW_S)
    return near & is_near(moments_s, time_s[opening > _OPEN], _OPEN_WINDOW_S)


def closures(real_s: Array, closed_s: Array, time_s: Array, opening: Array) -> Detections:
    """Compare closures of real and made lips.

    The made lips reproduce a real closure if they close within 40 ms. A made closure starts when
    open lips close. It is true if real lips are closed within 40 ms. Contacts more than 0.2 s from
    open lips are rest, not closures. ``real_s`` and ``closed_s`` are the results of
    ``real_closures`` and ``real_closed``; the opening is that of made lips.
    """
    is_met = is_closed_at(real_s, time_s, opening)
    is_open = opening > _OPEN
    touching = (opening < _CLOSED) & is_near(time_s, time_s[is_open], _OPEN_WINDOW_S)
    # A contact's number is how often the lips have opened before it. Contact 0 is the initial rest.
    state = np.where(is_open, 1, -1)[is_open | touching]
    number = np.cumsum(np.diff(state, prepend=-1) > 0)[state < 0]
    is_true = is_near(time_s[touching], closed_s, CLOSURE_WINDOW_S)
    made, true = np.unique(number[number > 0]), np.unique(number[(number > 0) & is_true])
    return Detections(len(real_s), int(is_met.sum()), len(made), len(true))


def openings(time_s: Array, opening: Array) -> Array:
    """Return when a mouth opens, seconds: its opening rises from 10 % to 30 % of its range."""
    is_known = ~np.isnan(opening)
    time_s, opening = time_s[is_known], opening[is_known]
    if not len(opening) or np.ptp(opening) == 0.0:
        return np.zeros(0)
    low, high = np.percentile(opening, [1, 99])
    level = (opening - low) / max(high - low, 1e-9)
    moments_s, was_low = [], False
    for k, value in enumerate(level):
        if value < _RISE_FROM:
            was_low = True
        elif value >= _RISE_TO and was_low:
            share = (_RISE_TO - level[k - 1]) / (value - level[k - 1])
            moments_s.append(time_s[k - 1] + share * (time_s[k] - time_s[k - 1]))
            was_low = False
    return np.array(moments_s)


def offsets(moments_s: Array, others_s: Array, window_s: float) -> Array:
    """Return the time from each moment to the nearest of the others, (n,); NaN beyond a window."""
    if not len(others_s):
        return np.full(len(moments_s), np.nan)
    nearest = np.abs(others_s - moments_s[:, None]).argmin(axis=1)
    offset = others_s[nearest] - moments_s
    return np.where(np.abs(offset) <= window_s, offset, np.nan)


def is_near(moments_s: Array, others_s: Array, window_s: float) -> Mask:
    """Whether one of the others, which are sorted, is within a window around each moment."""
    if not len(others_s):
        return np.zeros(len(moments_s), dtype=bool)
    after = np.searchsorted(others_s, moments_s)
    gaps = [
        np.abs(others_s[np.clip(index, 0, len(others_s) - 1)] - moments_s)
        for index in (after - 1, after)
    ]
    near: Mask = np.minimum(*gaps) <= window_s + _ROUNDING_S
    return near


def best_lag(lagged: Sequence[Moments], lags_s: Array) -> tuple[float, float] | None:
    """Return the highest correlation of a curve at several lags, and its lag in seconds.

    None if the curve is constant, or if the highest correlation is at an end of the lags, where it
    is not a maximum.
    """
    candidates = [
        (moments.correlation, float(lag_s))
        for moments, lag_s in zip(lagged, lags_s, strict=False)
        if moments.correlation is not None
    ]
    best = max(candidates, default=None)
    return best if best in candidates[1:-1] else None
