"""Light on teeth and tongue; little light passes a small mouth or protruding lips.

The light passes the gap between the lips, of height ``h``, onto teeth at a depth ``d``. It
increases with ``h`` and decreases with ``d``; the formula was chosen by eye.
``services/gateway/page/mouth-light.js`` is the same function.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_DEPTH = 500.0  # of the teeth behind the lips at rest, FAP units (MNS / 1024)
_SPREAD = 0.25
_FLOOR = 0.08


def mouth_light(faps: NDArray[np.float32]) -> float:
    """Return the share of the light, 0 to 1, for FAPs (68,)."""
    height = max(-float(faps[3] + faps[4]), 0.0)
    depth = max(_DEPTH + float(faps[15] + faps[16]) / 2, 0.0)
    through = height / (height + _SPREAD * depth**2 / _DEPTH + 1e-6)
    return min(1.0, _FLOOR + through)
