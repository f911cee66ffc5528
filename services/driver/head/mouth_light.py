"""How much light falls on teeth and tongue: little through a small mouth or behind pushed lips.

The light comes through the gap of the lips, of height ``h``, onto teeth at a depth ``d`` behind it.
What a tooth sees of the outside grows with ``h`` and falls with ``d``; the form below is chosen by
eye. ``services/gateway/page/mouth-light.js`` does the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_DEPTH = 500.0  # of the teeth behind the lips at rest, FAP units (MNS / 1024)
_SPREAD = 0.25
_FLOOR = 0.08


def mouth_light(faps: NDArray[np.float32]) -> float:
    """Share of the light, 0 to 1, for FAPs (68,)."""
    height = max(-float(faps[3] + faps[4]), 0.0)
    depth = max(_DEPTH + float(faps[15] + faps[16]) / 2, 0.0)
    through = height / (height + _SPREAD * depth**2 / _DEPTH + 1e-6)
    return min(1.0, _FLOOR + through)
