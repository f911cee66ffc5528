"""Mean temporal misalignment (MTM) of two curves of a mouth.

Source: Lee et al., "Perceptually accurate 3D talking head generation", CVPR 2025. The openings have
30 frames per second, as there, and are smoothed by a Gaussian of 2 frames. Derivative dynamic time
warping (Keogh and Pazzani 2001, with first differences) pairs frames. A pair counts if both frames
are maxima or minima, and the predicted one is between the real curve's neighboring extrema. The
misalignment is the mean absolute offset of the pairs of a clip.

Long clips are cut into segments of 8 s, because the paper's sequences are sentences.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from kouxing.evaluation.lips.mouths import Mouth
from kouxing.shared.arrays import Doubles

RATE_HZ = 30.0
_SMOOTHING, _SEGMENT_FRAMES = 2.0, 240  # frames


def misalignment_s(predicted: Mouth, real: Mouth) -> float | None:
    """Return the MTM of a clip, seconds; None if no extrema match."""
    if len(real.time_s) < 2:
        return None
    time_s = np.arange(real.time_s[0], real.time_s[-1], 1.0 / RATE_HZ)
    curves = [
        gaussian_filter1d(mouth.at("opening", time_s), sigma=_SMOOTHING)
        for mouth in (predicted, real)
    ]
    offsets = [
        offset
        for first in range(0, len(time_s), _SEGMENT_FRAMES)
        for offset in match_extrema(*(curve[first : first + _SEGMENT_FRAMES] for curve in curves))
    ]
    return float(np.mean(np.abs(offsets))) / RATE_HZ if offsets else None


def match_extrema(predicted: Doubles, real: Doubles) -> list[int]:
    """Return the lag of predicted extrema behind the matching real extrema, frames.

    >>> match_extrema(np.array([0.0, 0, 1, 4, 1, 0, 2, 2]), np.array([0.0, 1, 4, 1, 0, 2, 2, 1]))
    [1, 1]
    """
    kinds = [_find_extrema(curve) for curve in (predicted, real)]
    real_extrema = np.flatnonzero(kinds[1])
    offsets = []
    for j, i in warping_path(*(np.diff(curve, prepend=curve[:1]) for curve in (predicted, real))):
        if kinds[1][i] and kinds[0][j] == kinds[1][i]:
            index = int(np.searchsorted(real_extrema, i))
            first = real_extrema[index - 1] if index else 0
            last = real_extrema[index + 1] if index + 1 < len(real_extrema) else len(real) - 1
            if first <= j <= last:
                offsets.append(j - i)
    return offsets


def _find_extrema(curve: Doubles) -> NDArray[np.int_]:
    """Return 1 for maxima, -1 for minima, 0 otherwise. A plateau counts once, at its middle."""
    kind = np.zeros(len(curve), dtype=int)
    kind[find_peaks(curve)[0]] = 1
    kind[find_peaks(-curve)[0]] = -1
    return kind


def warping_path(first: Doubles, second: Doubles) -> list[tuple[int, int]]:
    """Pair the values of two sequences with the least sum of absolute differences, in order."""
    rows, columns = len(first), len(second)
    total = np.full((rows + 1, columns + 1), np.inf)
    total[0, 0] = 0.0
    cost = np.abs(first[:, None] - second)
    for diagonal in range(2, rows + columns + 1):  # a diagonal depends only on earlier diagonals
        row = np.arange(max(1, diagonal - columns), min(rows, diagonal - 1) + 1)
        column = diagonal - row
        best = np.minimum(total[row - 1, column], total[row, column - 1])
        best = np.minimum(best, total[row - 1, column - 1])
        total[row, column] = cost[row - 1, column - 1] + best
    path = []
    i, j = rows, columns
    while i > 0 and j > 0:
        path.append((i - 1, j - 1))
        steps = ((i - 1, j - 1), (i - 1, j), (i, j - 1))
        i, j = min(steps, key=lambda cell: total[cell])
    return path[::-1]
