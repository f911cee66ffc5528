"""Computes the mouth's FAPs from face landmarks, without head motion.

The landmarks come from MediaPipe's face mesh (Kartynnik et al. 2019, "Real-time facial surface
geometry from monocular video on mobile GPUs"), in pixels: x to the right, y down, z away from the
camera in the same unit (MediaPipe's x and z times the image width, y times its height). Left and
right are the person's.

======== ============================================================== =============
symbol   meaning                                                        unit, shape
======== ============================================================== =============
p        points of a frame                                              px, (43, 3)
c        points of MediaPipe's canonical face that neither mouth nor    cm, (25, 3)
         jaw move
s, R, t  scale, rotation and translation: c ~ s R p + t by least        1, (3, 3), cm
         squares (Umeyama 1991, eq. 39 to 43)
n        median of s R p + t over the neutral frames                    cm, (43, 3)
MNS0     nose to mouth in n                                             cm
MW0      width of the mouth in n                                        cm
======== ============================================================== =============

A FAP is the displacement of its feature point (ISO/IEC 14496-2, tables C-1 and C-5) from n in
MNS0 / 1024 or MW0 / 1024. The neutral frames are silent frames with closed lips. Depth (FAP 14,
16, 17) is omitted: measured with one camera, it did not follow the lips of a rendered head.
"""

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS

# Points of MediaPipe's canonical face model (Apache-2.0) that its own alignment uses, without jaw
# and cheeks: cm, right-handed, y up, z out of the face.
_STABLE_POINTS = {
    4: (0.000000, -0.463170, 7.586580),
    6: (0.000000, 2.473255, 5.788627),
    10: (0.000000, 8.261778, 4.481535),
    33: (-4.445859, 2.663991, 3.173422),
    54: (-6.279331, 6.615427, 1.425850),
    67: (-3.523964, 8.005976, 3.729163),
    117: (-5.258659, 0.945811, 2.974312),
    119: (-3.300681, 0.861641, 3.872784),
    121: (-1.820731, 1.467954, 4.224124),
    127: (-7.743095, 2.364999, -2.005167),
    129: (-1.785794, -0.978284, 4.850470),
    133: (-1.856432, 2.585245, 3.757904),
    143: (-6.407571, 2.236021, 1.560843),
    198: (-1.246815, 0.230297, 5.681036),
    263: (4.445859, 2.663991, 3.173422),
    284: (6.279331, 6.615427, 1.425850),
    297: (3.523964, 8.005976, 3.729163),
    346: (5.258659, 0.945811, 2.974312),
    348: (3.300681, 0.861641, 3.872784),
    350: (1.820731, 1.467954, 4.224124),
    356: (7.743095, 2.364999, -2.005167),
    358: (1.785794, -0.978284, 4.850470),
    362: (1.856432, 2.585245, 3.757904),
    372: (6.407571, 2.236021, 1.560843),
    420: (1.246815, 0.230297, 5.681036),
}
_UNDER_NOSE, _UPPER_LIP, _LOWER_LIP, _RIGHT_CORNER, _LEFT_CORNER = 2, 13, 14, 61, 291
_X, _Y = range(2)
# By FAP: landmark at its feature point, axis, and sign of the FAP's direction on that axis.
_FAP_LANDMARKS = {
    3: (152, _Y, -1), 4: (13, _Y, -1), 5: (14, _Y, 1), 6: (308, _X, 1), 7: (78, _X, -1),
    8: (311, _Y, -1), 9: (81, _Y, -1), 10: (402, _Y, 1), 11: (178, _Y, 1), 12: (308, _Y, 1),
    13: (78, _Y, 1), 51: (0, _Y, -1),
    52: (17, _Y, 1), 53: (291, _X, 1), 54: (61, _X, -1), 55: (269, _Y, -1), 56: (39, _Y, -1),
    57: (405, _Y, 1), 58: (181, _Y, 1), 59: (291, _Y, 1), 60: (61, _Y, 1),
}  # fmt: skip

LANDMARKS = tuple(
    sorted({*_STABLE_POINTS, _UNDER_NOSE, *(point for point, _, _ in _FAP_LANDMARKS.values())})
)
"""Indices of the needed landmarks among MediaPipe's 468, ascending."""

_QUIET_DB = 30.0  # silent frames are this much below loud frames
_LOUD_PERCENTILE = 95.0
_CLOSED_FRACTION = 0.35  # fraction of the frames whose lips count as closed
_CLOSED_FRACTION_SPEAKING = 0.08  # the same in recordings without silence
_MIN_NEUTRAL = 5  # frames


def compute_mouth_faps(landmarks: NDArray[np.floating], level_db: Doubles) -> Doubles:
    """Compute the FAPs of a mouth relative to its own neutral face, FAP units, (n, 28).

    ``landmarks`` are ``LANDMARKS`` of each frame, pixels, (n, 43, 3). ``level_db`` are the audio
    levels, (n,). FAPs without a landmark are NaN. Raises ``UserError`` if the landmarks do not form
    an upright face.
    """
    points = _align_head(landmarks.astype(np.float64))
    height = points[:, _landmark_index(_UPPER_LIP), _Y] - points[:, _landmark_index(_LOWER_LIP), _Y]
    neutral = np.median(points[_is_neutral(height, level_db)], axis=0)
    mouth_y = neutral[[_landmark_index(_UPPER_LIP), _landmark_index(_LOWER_LIP)], _Y].mean()
    nose_to_mouth = neutral[_landmark_index(_UNDER_NOSE), _Y] - mouth_y
    width = neutral[_landmark_index(_LEFT_CORNER), _X] - neutral[_landmark_index(_RIGHT_CORNER), _X]
    if not (nose_to_mouth > 0 and width > 0):
        raise UserError("the landmarks do not form an upright face; film the face from the front")
    faps = np.full((len(points), len(MOUTH_FAPS)), np.nan)
    for fap, (point, axis, sign) in _FAP_LANDMARKS.items():
        displacement = (
            points[:, _landmark_index(point), axis] - neutral[_landmark_index(point), axis]
        )
        unit = width if axis == _X else nose_to_mouth
        faps[:, MOUTH_FAPS.index(fap)] = sign * displacement * 1024 / unit
    return faps


def _landmark_index(point: int) -> int:
    return LANDMARKS.index(point)


def _align_head(landmarks: Doubles) -> Doubles:
    points = landmarks * (1, -1, -1)  # y up, z out of the face
    steady = points[:, [_landmark_index(point) for point in _STABLE_POINTS]]
    canonical = np.array(list(_STABLE_POINTS.values()))
    center, goal = steady.mean(axis=1, keepdims=True), canonical.mean(axis=0)
    steady = steady - center
    size = (steady**2).sum(axis=(1, 2))
    if not (size > 0).all():
        raise UserError("the landmarks of a frame coincide; omit frames without a face")
    covariance = np.einsum("ki,nkj->nij", canonical - goal, steady)
    left, strength, right = np.linalg.svd(covariance)
    strength[:, -1] *= np.sign(np.linalg.det(left @ right))  # no reflection
    left[:, :, -1] *= np.sign(np.linalg.det(left @ right))[:, None]
    scale = strength.sum(axis=1) / size
    aligned: Doubles = scale[:, None, None] * (points - center) @ (left @ right).transpose(0, 2, 1)
    aligned += goal
    return aligned


def _is_neutral(height: Doubles, level_db: Doubles) -> Mask:
    quiet = level_db < np.percentile(level_db, _LOUD_PERCENTILE) - _QUIET_DB
    neutral: Mask = quiet & (height <= np.quantile(height, _CLOSED_FRACTION))
    if neutral.sum() < _MIN_NEUTRAL:
        neutral = height <= np.quantile(height, _CLOSED_FRACTION_SPEAKING)
    return neutral
