"""The face that is shown while no session sends frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import IdleMotion

RESTING_RATE_HZ = 25.0
STALL_S = 1.0  # a face without new frames for this time fades to rest
FADE_S = 0.3


class RestingFace:
    """A face with idle motion only; with seed 0 it does not move."""

    def __init__(self, seed: int) -> None:
        self._motion = IdleMotion(seed) if seed else None
        self._start_s: float | None = None

    def faps(self, now_s: float) -> NDArray[np.float32]:
        """Return the FAPs (68,) at a time of any clock; times must not decrease."""
        self._start_s = now_s if self._start_s is None else self._start_s
        faps = np.zeros(NUM_FAPS, np.float32)
        if self._motion is not None:
            self._motion.apply(faps, now_s - self._start_s)
        return faps

    def blend(self, face: NDArray[np.float32], share: float, now_s: float) -> NDArray[np.float32]:
        """Return a mixture (68,) of another face, with the given share, and the resting face."""
        rest = self.faps(now_s)
        return rest + np.float32(share) * (face - rest)
