"""One frame of a face, in the terms of other programs."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import FAP_NUMBER, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.shapes import SHAPE_SETS

_HEAD = [FAP_NUMBER[f"head_{axis}"] - 1 for axis in ("pitch", "yaw", "roll")]
_EYES = [
    FAP_NUMBER[name] - 1
    for name in ("yaw_l_eyeball", "pitch_l_eyeball", "yaw_r_eyeball", "pitch_r_eyeball")
]
_LIPS = [FAP_NUMBER[name] - 1 for name in ("lower_t_midlip", "raise_b_midlip")]
_OPEN_LIPS = 880.0  # FAP units from one lip to the other in a wide "a"
_NO_MOUTH = ("brow", "eye", "blink", "look", "cheekSquint", "nose")  # how shapes' names begin

Angles = tuple[float, float, float]


class Face:
    """A face that is shown; what a program takes of it is worked out once for all targets.

    Parameters
    ----------
    faps
        Facial animation parameters (68,), FAP units.
    time_s
        Media time, seconds; at rest it goes on from the last frame's, and before any from 0.
    """

    def __init__(self, faps: NDArray[np.float32], time_s: float) -> None:
        self.faps = faps
        self.time_s = time_s
        self._weights: dict[str, dict[str, float]] = {}

    def weights(self, shapes: str, *, is_mouth_only: bool = False) -> dict[str, float]:
        """Return weights from 0 to 1 by name, of one of ``SHAPE_SETS``."""
        if shapes not in self._weights:
            shape_set = SHAPE_SETS[shapes]
            values = shape_set.weights(self.faps).tolist()
            self._weights[shapes] = dict(zip(shape_set.names, values, strict=True))
        weights = self._weights[shapes]
        if is_mouth_only:
            return {name: weights[name] for name in weights if not name.startswith(_NO_MOUTH)}
        return weights

    @property
    def head(self) -> Angles:
        """How far the head is turned down, to its left, and tilted to its right; rad."""
        pitch, yaw, roll = (self.faps[_HEAD] * RADIANS_PER_ANGLE_UNIT).tolist()
        return pitch, yaw, roll

    @property
    def eyes(self) -> tuple[float, float, float, float]:
        """How far the left eye is turned to the left and down, and the right one; rad."""
        yaw_l, pitch_l, yaw_r, pitch_r = (self.faps[_EYES] * RADIANS_PER_ANGLE_UNIT).tolist()
        return yaw_l, pitch_l, yaw_r, pitch_r

    @cached_property
    def opening(self) -> float:
        """How far the lips are apart, from 0 to 1 (a wide "a")."""
        return max(0.0, min(1.0, -float(self.faps[_LIPS].sum()) / _OPEN_LIPS))
