"""The best linear map from the outputs of other lip sync to a mouth.

======== ============================================================== ==============
symbol   meaning                                                        unit, shape
======== ============================================================== ==============
r(T)     row of outputs once the sound up to T is known (``rows.py``)    (outputs,)
d        delay of the face                                              s
m        opening, width and jaw of a mouth                              FAP units, (3,)
W        weights, by ridge regression on the clips to learn from         (10, outputs, 3)
======== ============================================================== ==============

    m(t) = c + sum_k W_k r(t + d - 0.02 s k),  k = 0 ... 9

So a lag of the outputs is compensated as far as the delay allows. Each clip's own means are removed
for W, as they are for scoring. A regression shrinks what it is unsure of: then the opening is
stretched to the extent of the real one, and set so low that most closures of the clips to learn
from are met (F1); neither changes a correlation. Source: Hoerl and Kennard 1970, "Ridge
regression". Length of the history and ridge were chosen on the clips of the part ``choice``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.evaluation.lips.clip_scores import MEASURES, real_faps
from kouxing.evaluation.lips.measures import Hits, closures, real_closures, real_shut
from kouxing.evaluation.lips.rivals.rows import ROW_S
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ
from kouxing.shared.face.faps import NUM_FAPS

Array = NDArray[np.float64]

_HISTORY, _HISTORY_STEP = 10, 2  # rows: every second one of the last 0.2 s
_RIDGE = 1000.0  # weight of zero, frames
_SHUT_SHARES = range(0, 65, 5)  # of the frames, per cent: tried
_OPENING = list(MEASURES).index("opening")


@dataclass(frozen=True, slots=True)
class LinearMap:
    """From rows to opening, width and jaw."""

    delay_s: float
    weights: Array  # (history * outputs, 3)
    constant: Array  # (3,)

    def frames(self, rows: Array, num_frames: int) -> Array:
        """Make frames (num_frames, 68) from rows."""
        time_s = np.arange(num_frames) / FRAME_RATE_HZ
        made = history(rows, time_s + self.delay_s) @ self.weights + self.constant
        opening, width, jaw = made.T
        faps = np.zeros((num_frames, NUM_FAPS))
        faps[:, 2], faps[:, 4] = jaw, -opening
        faps[:, 5] = faps[:, 6] = width / 2.0
        return faps


def history(rows: Array, known_s: Array) -> Array:
    """Return the last rows that come from sound up to some times, (n, history * outputs)."""
    newest = np.floor(known_s / ROW_S + 1e-6).astype(int)
    index = newest[:, None] - _HISTORY_STEP * np.arange(_HISTORY)
    return rows[np.clip(index, 0, len(rows) - 1)].reshape(len(known_s), -1)


def fit(clips: Sequence[LipClip], rows: Mapping[str, Array], delay_s: float) -> LinearMap:
    """Fit the map for a delay.

    Parameters
    ----------
    clips
        To learn from.
    rows
        Of each clip, by name.
    """
    inputs = [history(rows[clip.name], clip.time_s + delay_s) for clip in clips]
    fitted = []
    for measure in MEASURES.values():
        pairs = [(x, measure(real_faps(clip))) for x, clip in zip(inputs, clips, strict=True)]
        known = [(x[~np.isnan(y)], y[~np.isnan(y)]) for x, y in pairs if not np.isnan(y).all()]
        centred_x = np.concatenate([x - x.mean(axis=0) for x, _ in known])
        centred_y = np.concatenate([y - y.mean() for _, y in known])
        # ridge regression on outputs of extent 1
        extent = centred_x.std(axis=0) + 1e-6
        scaled = centred_x / extent
        gram = scaled.T @ scaled + _RIDGE * np.eye(len(extent))
        fitted.append(np.linalg.solve(gram, scaled.T @ centred_y) / extent)
        if measure is MEASURES["opening"]:
            fitted[-1] *= centred_y.std() / (centred_x @ fitted[-1]).std()
    flat = LinearMap(delay_s, np.stack(fitted, axis=1), np.zeros(len(MEASURES)))
    return replace(flat, constant=_constant(flat, clips, rows))


def _constant(flat: LinearMap, clips: Sequence[LipClip], rows: Mapping[str, Array]) -> Array:
    """Find the constant of the opening whose closures are the best on some clips."""
    made = []
    for clip in clips:
        num_frames = int(len(clip.samples) / SAMPLE_RATE_HZ * FRAME_RATE_HZ) + 1
        faps = flat.frames(rows[clip.name], num_frames)
        made.append(MEASURES["opening"](faps))

    def f1(constant: float) -> float:
        hits = (
            _closures(clip, opening + constant)
            for clip, opening in zip(clips, made, strict=True)
            if clip.is_in_sync
        )
        return reduce(add, hits, Hits()).f1 or 0.0

    constant = np.zeros(len(MEASURES))
    constant[_OPENING] = max(-np.percentile(np.concatenate(made), _SHUT_SHARES), key=f1)
    return constant


def _closures(clip: LipClip, opening: Array) -> Hits:
    real = MEASURES["opening"](real_faps(clip))
    time_s = np.arange(len(opening)) / FRAME_RATE_HZ
    shut_s = real_shut(clip.time_s, real)
    return closures(real_closures(clip.time_s, real), shut_s, time_s, opening)
