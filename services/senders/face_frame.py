"""Converts a frame of the face to the parameters of other programs."""

from functools import cached_property

from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import FAP_NUMBER, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.shapes import SHAPE_SETS

_HEAD = [FAP_NUMBER[f"head_{axis}"] - 1 for axis in ("pitch", "yaw", "roll")]
_EYES = [
    FAP_NUMBER[name] - 1
    for name in ("yaw_l_eyeball", "pitch_l_eyeball", "yaw_r_eyeball", "pitch_r_eyeball")
]
_LIPS = [FAP_NUMBER[name] - 1 for name in ("lower_t_midlip", "raise_b_midlip")]
_OPEN_LIPS = 880.0  # FAP units between the lips in a wide "a"
_OUTSIDE_MOUTH = ("brow", "eye", "blink", "look", "cheekSquint", "nose")  # prefixes of shape names


def mouth_shape_names(shapes: str) -> list[str]:
    """Return the names of the mouth's shapes in one of ``SHAPE_SETS``."""
    return [name for name in SHAPE_SETS[shapes].names if not name.startswith(_OUTSIDE_MOUTH)]


Angles = tuple[float, float, float]


class FaceFrame:
    """A frame, FAPs (68,). All targets share its conversions, which are computed once.

    ``time_s`` is media time. At rest it continues from the last frame, or from 0.
    """

    def __init__(self, faps: Floats, time_s: float) -> None:
        self.faps = faps
        self.time_s = time_s
        self._weights: dict[str, dict[str, float]] = {}

    def weights(self, shapes: str, *, is_mouth_only: bool = False) -> dict[str, float]:
        """Return the weights, 0 to 1, of one of ``SHAPE_SETS`` by shape name."""
        if shapes not in self._weights:
            shape_set = SHAPE_SETS[shapes]
            values = shape_set.weights(self.faps).tolist()
            self._weights[shapes] = dict(zip(shape_set.names, values, strict=True))
        weights = self._weights[shapes]
        if is_mouth_only:
            return {name: weights[name] for name in mouth_shape_names(shapes)}
        return weights

    @property
    def head(self) -> Angles:
        """Pitch (down), yaw (to the subject's left) and roll (to the subject's right), rad."""
        pitch, yaw, roll = (self.faps[_HEAD] * RADIANS_PER_ANGLE_UNIT).tolist()
        return pitch, yaw, roll

    @property
    def eyes(self) -> tuple[float, float, float, float]:
        """Yaw (left) and pitch (down) of the left eye, then of the right eye, rad."""
        yaw_l, pitch_l, yaw_r, pitch_r = (self.faps[_EYES] * RADIANS_PER_ANGLE_UNIT).tolist()
        return yaw_l, pitch_l, yaw_r, pitch_r

    @cached_property
    def opening(self) -> float:
        """Distance between the lips, 0 to 1 (a wide "a")."""
        return max(0.0, min(1.0, -float(self.faps[_LIPS].sum()) / _OPEN_LIPS))
