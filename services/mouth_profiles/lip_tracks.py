"""Converts and compares tracked lips, in the form that the lip predictor uses."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.slices import level_db
from kouxing.services.recognizer.lips.lip_predictor import LIP_FAPS, OTHER_SIDE
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.face.faps import MOUTH_FAPS

MEASURES = ("opening", "width", "jaw")
LEVEL_STEP_S = 0.02

_MAX_GAP_S = 0.1  # longer gaps between tracked frames are not interpolated
_MAX_SLOW_GAP_S = 0.3  # the same for cameras with few frames per second
_JITTER = 1.3  # multiple of the interval between images
_SIDES = [[MOUTH_FAPS.index(fap), MOUTH_FAPS.index(OTHER_SIDE.get(fap, fap))] for fap in LIP_FAPS]
_JAW, _UPPER_LIP, _LOWER_LIP, _CORNER = (LIP_FAPS.index(fap) for fap in (3, 4, 5, 6))


def select_lip_faps(faps: Doubles) -> Doubles:
    """Select lip FAPs from mouth FAPs, (n, 28) to (n, 15). Left and right are averaged."""
    return np.stack([faps[:, pair].mean(axis=1) for pair in _SIDES], axis=1)


def lip_measures(lips: NDArray[np.floating]) -> Doubles:
    """Compute opening, width and jaw, (n, 3), from FAPs, (n, 15 or more)."""
    height = -lips[:, _UPPER_LIP] - lips[:, _LOWER_LIP]
    return np.stack([height, 2 * lips[:, _CORNER], lips[:, _JAW]], axis=1)


def interpolate_track(frame_s: Doubles, values: Doubles, time_s: Doubles) -> Doubles:
    """Interpolate a track, (n,), at times of any shape; NaN outside it and within long gaps."""
    known = ~np.isnan(values)
    if known.sum() < 2:
        return np.full(time_s.shape, np.nan)
    interval_s = float(np.median(np.diff(frame_s)))
    max_gap_s = min(max(_MAX_GAP_S, _JITTER * interval_s), _MAX_SLOW_GAP_S)
    frame_s, values = frame_s[known], values[known]
    after = np.clip(np.searchsorted(frame_s, time_s), 1, len(frame_s) - 1)
    is_gap = frame_s[after] - frame_s[after - 1] > max_gap_s
    outside = (time_s < frame_s[0]) | (time_s > frame_s[-1])
    interpolated: Doubles = np.interp(time_s, frame_s, values)
    return np.where(is_gap | outside, np.nan, interpolated)


def correlate_curves(pairs: Sequence[tuple[Doubles, Doubles]]) -> Doubles:
    """Correlate predicted and tracked curves, (n, curves) each, pooled over the pairs.

    Each pair's means are removed first. NaN values are ignored. The result is NaN for a curve that
    does not move.
    """
    figures = []
    for curve in range(pairs[0][0].shape[1]):
        sums = np.zeros((2, 2))
        for pair in pairs:
            both = np.stack([curves[:, curve] for curves in pair])
            both = both[:, ~np.isnan(both).any(axis=0)]
            if both.size:
                centered = both - both.mean(axis=1, keepdims=True)
                sums += centered @ centered.T
        size = np.sqrt(sums[0, 0] * sums[1, 1])
        figures.append(sums[0, 1] / size if size > 0 else np.nan)
    return np.array(figures)


def measure_levels(samples: Floats) -> list[tuple[float, float]]:
    """Measure the level as the live system does: pairs of time (s) and level (dB full scale)."""
    step = round(LEVEL_STEP_S * MEDIA_RATE_HZ)
    ends = range(step, len(samples) + 1, step)
    return [(end / MEDIA_RATE_HZ, level_db(samples[end - step : end])) for end in ends]
