"""Curves of a mouth: correlation, error and lag of two curves, and how often a curve turns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kouxing.shared.arrays import Doubles, Mask

LAGS_S = np.arange(-30, 31) / 100.0
_NO_POWER = 1e-12  # per frame: what filters leave of a constant curve
_ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class Moments:
    """Second moments of a predicted and a real curve, after removal of each clip's mean."""

    num_frames: int = 0
    products: float = 0.0
    predicted_power: float = 0.0
    real_power: float = 0.0

    @property
    def correlation(self) -> float | None:
        """Pearson correlation; None if a curve is constant."""
        if min(self.predicted_power, self.real_power) <= _NO_POWER * self.num_frames:
            return None
        return self.products / float(np.sqrt(self.predicted_power * self.real_power))

    @property
    def rmse(self) -> float | None:
        """Root mean square error; None without frames."""
        if not self.num_frames:
            return None
        squares = self.predicted_power + self.real_power - 2.0 * self.products
        return float(np.sqrt(max(squares, 0.0) / self.num_frames))


def pooled_moments(pairs: Iterable[tuple[Doubles, Doubles]]) -> Moments:
    """Compare predicted and real curves, a pair per clip. NaN values are ignored.

    >>> predicted, real = np.array([1.0, 2.0, 3.0]), np.array([10.0, 12.0, 11.0])
    >>> round(pooled_moments([(predicted, real)]).correlation, 6)
    0.5
    """
    sums = np.zeros(4)
    for predicted, real in pairs:
        is_known = ~np.isnan(predicted + real)
        if is_known.any():
            x, y = (curve[is_known] - curve[is_known].mean() for curve in (predicted, real))
            sums += len(x), x @ y, x @ x, y @ y
    return Moments(int(sums[0]), *map(float, sums[1:]))


def best_lag(lagged: Sequence[Moments]) -> float | None:
    """Return which of ``LAGS_S`` has the highest correlation, seconds.

    None if the curve is constant, or if the highest correlation is at an end of the lags, where it
    is not a maximum.
    """
    candidates = [
        (moments.correlation, float(lag_s))
        for moments, lag_s in zip(lagged, LAGS_S, strict=True)
        if moments.correlation is not None
    ]
    best = max(candidates, default=None)
    return best[1] if best in candidates[1:-1] else None


def num_turns(curve: Doubles) -> int:
    """Count the changes of direction of a curve.

    >>> num_turns(np.array([0.0, 1.0, 1.0, 2.0, 1.0, 3.0]))
    2
    """
    direction = np.sign(np.diff(curve))
    return int((np.diff(direction[direction != 0.0]) != 0.0).sum())


def rms_jerk(curves: Sequence[Doubles], rate_hz: float) -> float | None:
    """Root mean square of the third derivative of curves; None if none has four frames."""
    jerks = np.concatenate([np.zeros(0), *(np.diff(curve, n=3) for curve in curves)]) * rate_hz**3
    return float(np.sqrt(np.mean(jerks**2))) if len(jerks) else None


def is_near(events_s: Doubles, others_s: Doubles, window_s: float) -> Mask:
    """Whether one of the others, which are sorted, is within a window around each moment."""
    if not len(others_s):
        return np.zeros(len(events_s), dtype=bool)
    after = np.searchsorted(others_s, events_s)
    gaps = [
        np.abs(others_s[np.clip(index, 0, len(others_s) - 1)] - events_s)
        for index in (after - 1, after)
    ]
    return np.minimum(*gaps) <= window_s + _ROUNDING_S
