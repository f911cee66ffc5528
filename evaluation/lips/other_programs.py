"""The mouths of other programs: as shipped and through a linear map, each at its best delay.

A frame for time t of a face with delay d uses the rows of a table up to t + d. The correlation of
the opening on the training clips selects the delay. Without tables of training clips, there is no
linear map, and the delay is 0. The linear map is

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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.agreement import moments
from kouxing.evaluation.lips.closures import DetectionCounts, closures
from kouxing.evaluation.lips.curve_tables import CurveTable, fap_conversion, read_tables
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import CURVES, Mouth, clip_mouth, predicted_mouth, real_faps
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.face.faps import NUM_FAPS

Array = NDArray[np.float64]
MouthFunction = Callable[[LipClip], Mouth]
FapsFunction = Callable[[LipClip, Array], Array]  # clip, times (n,) in s; FAPs (n, 68)

_DELAYS_S = tuple(step / 50.0 for step in range(16))  # 0 to 0.3 s
_TAIL_S = 0.5  # frames after the end of a clip's audio
_HISTORY_S = 0.02 * np.arange(10)
_RIDGE = 1000.0  # strength of the regularization, frames
_TOLERANCE = 0.005  # tolerance of the correlation
_CLOSED_PERCENTS = range(0, 65, 5)  # percentages of the frames that the constant may close
_JAW, _LOWER_LIP, _CORNERS = 2, 4, (5, 6)  # columns of FAPs


def load_programs(
    folders: Sequence[Path], held_out: Sequence[LipClip], training: Sequence[LipClip]
) -> dict[str, MouthFunction]:
    """Load the mouths of other programs from folders of tables; return them by title.

    Raises ``UserError`` if a table is missing or cannot be used (see ``read_tables``).
    """
    mouths: dict[str, MouthFunction] = {}
    for folder in folders:
        tables = read_tables(folder, held_out, training)
        fitting = [clip for clip in training if clip.name in tables and clip.is_in_sync]
        mouths |= _mouths_of(folder, tables, fitting)
    return mouths


def load_program_faps(folder: Path, clips: Sequence[LipClip]) -> FapsFunction:
    """Load a program's curves as shipped, at the delay that agrees best with the given clips.

    Raises ``UserError`` if a table is missing or cannot be used (see ``read_tables``).
    """
    faps_of, _ = _program_faps(folder, read_tables(folder, clips, ()), clips)
    return faps_of


def _program_faps(
    folder: Path, tables: Mapping[str, CurveTable], fitting: Sequence[LipClip]
) -> tuple[FapsFunction, float]:
    """Return the FAPs of a face, and its delay, seconds."""
    shipped = fap_conversion(folder, [*tables.values()])

    def faps(clip: LipClip, time_s: Array, delay_s: float) -> Array:
        return shipped.faps(tables[clip.name].at(time_s + delay_s))

    reals = [clip_mouth(clip) for clip in fitting]

    def agreement(delay_s: float) -> float:
        pairs = [
            (predicted_mouth(faps(clip, _frames_s(clip), delay_s)), real)
            for clip, real in zip(fitting, reals, strict=True)
        ]
        return moments(pairs, "opening").correlation or 0.0

    delay_s = max(_DELAYS_S, key=agreement) if fitting else 0.0
    return partial(faps, delay_s=delay_s), delay_s


def _mouths_of(
    folder: Path, tables: Mapping[str, CurveTable], fitting: Sequence[LipClip]
) -> dict[str, MouthFunction]:
    faps_of, delay_s = _program_faps(folder, tables, fitting)
    title = f"{folder.name}, {1e3 * delay_s:.0f} ms"
    mouths: dict[str, MouthFunction] = {
        title: lambda clip: predicted_mouth(faps_of(clip, _frames_s(clip)))
    }
    if fitting:
        linear = fit_map(fitting, tables, _DELAYS_S[::2])
        title = f"{folder.name}, fitted, {1e3 * linear.delay_s:.0f} ms"
        mouths[title] = lambda clip: predicted_mouth(
            linear.faps(tables[clip.name], _frames_s(clip))
        )
    return mouths


def _frames_s(clip: LipClip) -> Array:
    duration_s = max(float(clip.time_s[-1]), len(clip.samples) / MEDIA_RATE_HZ)
    return np.arange(int((duration_s + _TAIL_S) * FRAME_RATE_HZ)) / FRAME_RATE_HZ


@dataclass(frozen=True, slots=True)
class LinearMap:
    """A fitted map."""

    delay_s: float
    weights: Array  # (10 * num_curves, 3)
    opening: float  # constant, FAP units
    correlation: float  # correlation of the opening on the clips of the fit

    def faps(self, table: CurveTable, time_s: Array) -> Array:
        """Return FAPs (num_frames, 68) at given times."""
        opening, width, jaw = (_stack_history(table, time_s + self.delay_s) @ self.weights).T
        faps = np.zeros((len(time_s), NUM_FAPS))
        faps[:, _JAW], faps[:, _LOWER_LIP] = jaw, -opening - self.opening
        faps[:, _CORNERS] = width[:, None] / 2.0
        return faps


def _stack_history(table: CurveTable, known_s: Array) -> Array:
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
