"""How well mouths agree with others at the same times: correlation, error, lag and closures."""

from collections.abc import Sequence
from dataclasses import dataclass

from kouxing.evaluation.lips.closures import DetectionCounts, closures
from kouxing.evaluation.lips.curves import LAGS_S, Moments, best_lag, pooled_moments
from kouxing.evaluation.lips.mouths import CURVES, Mouth

MouthPair = tuple[Mouth, Mouth]  # the predicted and the real mouth


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Agreement of several pairs; None if nothing moves or nothing was measured."""

    num_clips: int
    correlation: dict[str, float | None]  # for opening, width and jaw
    error: float | None  # error of the opening, FAP units
    lag_ms: float | None  # lag of the opening
    closure_f1: float | None


def agreement_of(pairs: Sequence[MouthPair]) -> Agreement:
    """Compare mouths."""
    return Agreement(
        num_clips=len(pairs),
        correlation={name: moments(pairs, name).correlation for name in CURVES},
        error=moments(pairs, "opening").rmse,
        lag_ms=lag_ms(pairs),
        closure_f1=sum((closures(*pair) for pair in pairs), DetectionCounts()).f1,
    )


def moments(pairs: Sequence[MouthPair], curve: str, lag_s: float = 0.0) -> Moments:
    """Compare a curve over all frames, after removal of each clip's means."""
    return pooled_moments(
        (predicted.at(curve, real.time_s + lag_s), real.curves[curve]) for predicted, real in pairs
    )


def lag_ms(pairs: Sequence[MouthPair]) -> float | None:
    """Return the lag of the opening with the highest correlation, ms; positive: late.

    Viewers notice sound that is 45 ms early or 125 ms late (ITU-R BT.1359-1).

    >>> import numpy as np
    >>> time_s = np.arange(0.0, 4.0, 0.02)
    >>> real, late = (
    ...     Mouth(time_s, {"opening": np.sin(6.0 * (time_s - delay_s))}, time_s < 0.0)
    ...     for delay_s in (0.0, 0.06)
    ... )
    >>> lag_ms([(late, real)])
    60
    """
    lag_s = best_lag([moments(pairs, "opening", lag_s) for lag_s in LAGS_S])
    return None if lag_s is None else round(1e3 * lag_s)
