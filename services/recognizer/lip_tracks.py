"""Tracked lips as lips from sound know them, at the times that it asks for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.lips import LIP_FAPS, OTHER_SIDE
from kouxing.shared.face.faps import MOUTH_FAPS

Array = NDArray[np.float64]

MEASURES = ("opening", "width", "jaw")

_MAX_GAP_S = 0.1  # between two tracked frames that are interpolated
_SIDES = [[MOUTH_FAPS.index(fap), MOUTH_FAPS.index(OTHER_SIDE.get(fap, fap))] for fap in LIP_FAPS]
_JAW, _UPPER_LIP, _LOWER_LIP, _CORNER = (LIP_FAPS.index(fap) for fap in (3, 4, 5, 6))


def lip_tracks(faps: Array) -> Array:
    """Return of the mouth's FAPs, (n, 28), those of the lips, left and right averaged, (n, 15)."""
    return np.stack([faps[:, pair].mean(axis=1) for pair in _SIDES], axis=1)


def measures_of(lips: NDArray[np.floating]) -> Array:
    """Return opening, width and jaw, (n, 3), of FAPs, (n, 15 or more)."""
    height = -lips[:, _UPPER_LIP] - lips[:, _LOWER_LIP]
    measures: Array = np.stack([height, 2 * lips[:, _CORNER], lips[:, _JAW]], axis=1)
    return measures


def values_at(frame_s: Array, values: Array, time_s: Array) -> Array:
    """Interpolate a track, (n,); NaN outside it and within its gaps."""
    known = ~np.isnan(values)
    if known.sum() < 2:
        return np.full(time_s.shape, np.nan)
    frame_s, values = frame_s[known], values[known]
    after = np.clip(np.searchsorted(frame_s, time_s), 1, len(frame_s) - 1)
    is_gap = frame_s[after] - frame_s[after - 1] > _MAX_GAP_S
    outside = (time_s < frame_s[0]) | (time_s > frame_s[-1])
    made: Array = np.interp(time_s, frame_s, values)
    return np.where(is_gap | outside, np.nan, made)
