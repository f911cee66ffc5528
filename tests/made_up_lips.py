"""A lip predictor without training: louder sound opens the jaw further."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipPositions

JAW = MOUTH_FAPS.index(3)


@dataclass(frozen=True)
class LoudLips:
    """Supports any delays; the network's output has a small effect."""

    delays_s: Sequence[float] = (-0.005, 0.025, 0.085, 0.145)

    def create_stream(self, delays_s: Sequence[float]) -> LoudLipStream:
        assert set(delays_s) <= set(self.delays_s)
        return LoudLipStream(delays_s)

    def with_mouth_profile(self, profile: bytes) -> LoudLips:
        raise UserError(f"it is not a mouth profile: {profile!r}")


class LoudLipStream:
    """Counts the earlier positions of the segment."""

    def __init__(self, delays_s: Sequence[float]) -> None:
        self._delays_s = delays_s
        self.reset()

    def reset(self) -> None:
        self._num_positions = 0

    def process_position(
        self,
        known_s: float,
        frames: NDArray[np.float32],
        values: NDArray[np.float32],
    ) -> list[LipPositions]:
        self._num_positions += 1
        assert frames.shape == (2, 80)
        assert values.ndim == 3
        loudness = 1.0 / (1.0 + np.exp(-4.0 * frames.mean()))
        faps = np.zeros(len(MOUTH_FAPS), np.float32)
        faps[JAW] = 400.0 * loudness + 0.2 * values.mean()
        faps[JAW + 1] = self._num_positions
        return [
            LipPositions(
                time_s=known_s - delay_s,
                delay_s=delay_s,
                faps=faps,
                closure=float(1.0 - loudness),
                lip_to_teeth=0.0,
            )
            for delay_s in self._delays_s
        ]
