"""The best linear map from the curves of another program to a mouth.

    m(t) = c + sum_k W_k r(t + d - 0.02 s k),  k = 0 ... 9

======== ================================================================ ==================
symbol   meaning                                                          unit, shape
======== ================================================================ ==================
r(T)     curves that need no audio after T                                (num_curves,)
d        delay of the face                                                s
m        opening, width and jaw of the mouth                              FAP units, (3,)
W        weights, by ridge regression (Hoerl and Kennard 1970)            (10, num_curves, 3)
======== ================================================================ ==================

W is fitted after each clip's means are subtracted, as in scoring. Ridge regularization reduces the
range of the opening, so the opening is scaled to the standard deviation of the real opening. The
constant of the opening maximizes the F1 of closures.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.closures import DetectionCounts, closures
from kouxing.evaluation.lips.curve_tables import CurveTable
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import CURVES, clip_mouth, predicted_mouth, real_faps
from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import NUM_FAPS

_HISTORY_S = 0.02 * np.arange(10)
_RIDGE = 1000.0  # strength of the regularization, frames
_TOLERANCE = 0.005  # tolerance of the correlation
_CLOSED_PERCENTS = range(0, 65, 5)  # percentages of the frames that the constant may close
_JAW, _LOWER_LIP, _CORNERS = 2, 4, (5, 6)  # columns of FAPs


@dataclass(frozen=True, slots=True)
class LinearMap:
    """A fitted map."""

    delay_s: float
    weights: Doubles  # (10 * num_curves, 3)
    opening: float  # constant, FAP units
    correlation: float  # correlation of the opening on the clips of the fit

    def faps(self, table: CurveTable, time_s: Doubles) -> Doubles:
        """Return FAPs (num_frames, 68) at given times."""
        opening, width, jaw = (_stack_history(table, time_s + self.delay_s) @ self.weights).T
        faps = np.zeros((len(time_s), NUM_FAPS))
        faps[:, _JAW], faps[:, _LOWER_LIP] = jaw, -opening - self.opening
        faps[:, _CORNERS] = width[:, None] / 2.0
        return faps


def _stack_history(table: CurveTable, known_s: Doubles) -> Doubles:
    return table.at(known_s[:, None] - _HISTORY_S).reshape(len(known_s), -1)


def fit_map(
    clips: Sequence[LipClip], tables: Mapping[str, CurveTable], delays_s: Sequence[float]
) -> LinearMap:
    """Fit the map on training clips.

    Uses the shortest delay whose correlation of the opening is within 0.005 of the best.
    """
    maps = [_fit(clips, tables, delay_s) for delay_s in sorted(delays_s)]
    best = max(linear.correlation for linear in maps)
    chosen = next(linear for linear in maps if linear.correlation >= best - _TOLERANCE)
    return replace(chosen, opening=_best_constant(chosen, clips, tables))


def _fit(clips: Sequence[LipClip], tables: Mapping[str, CurveTable], delay_s: float) -> LinearMap:
    inputs = [_stack_history(tables[clip.name], clip.time_s + delay_s) for clip in clips]
    weights = []
    correlation = 0.0
    for name, curve in CURVES.items():
        pairs = [(x, curve(real_faps(clip))) for x, clip in zip(inputs, clips, strict=True)]
        known = [(x[~np.isnan(y)], y[~np.isnan(y)]) for x, y in pairs if not np.isnan(y).all()]
        x = np.concatenate([x - x.mean(axis=0) for x, _ in known])
        y = np.concatenate([y - y.mean() for _, y in known])
        deviation = x.std(axis=0) + 1e-6
        x /= deviation
        solution = np.linalg.solve(x.T @ x + _RIDGE * np.eye(x.shape[1]), x.T @ y)
        predicted = x @ solution
        if name == "opening" and predicted.any():
            correlation = float(np.corrcoef(predicted, y)[0, 1])
            solution *= y.std() / predicted.std()
        weights.append(solution / deviation)
    return LinearMap(delay_s, np.stack(weights, axis=1), 0.0, correlation)


def _best_constant(
    linear: LinearMap, clips: Sequence[LipClip], tables: Mapping[str, CurveTable]
) -> float:
    """Return the constant of the opening with the best F1 of closures on some clips."""
    reals = [clip_mouth(clip) for clip in clips]
    predicted = [
        linear.faps(tables[clip.name], np.arange(0.0, clip.time_s[-1], 1.0 / FRAME_RATE_HZ))
        for clip in clips
    ]

    def f1(constant: float) -> float:
        shift = np.zeros(NUM_FAPS)
        shift[_LOWER_LIP] = -constant
        pairs = zip(predicted, reals, strict=True)
        detections = (closures(predicted_mouth(faps + shift), real) for faps, real in pairs)
        return sum(detections, DetectionCounts()).f1 or 0.0

    openings = np.concatenate([CURVES["opening"](faps) for faps in predicted])
    return max((float(c) for c in -np.percentile(openings, _CLOSED_PERCENTS)), key=f1)
