"""How long units last, by their place between two pauses, measured on forced alignments.

Li et al. 2011 put a unit out live with the mean duration it has in the corpus. The last final
before a pause is much longer than the same final inside a phrase (Klatt 1976, "Linguistic uses of
segmental duration in English", found it for English; it holds in Mandarin too), so the statistics
are kept apart by position.

A position that a unit seldom has, such as an initial before a pause, leans on the unit's own mean:

    mean[p, u] = (sum[p, u] + n0 * mean[u]) / (count[p, u] + n0)

and the second moment likewise. Isolated words and syllables are drawn out: they count little, so
that they only serve where there is no connected speech.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import FIRST, INSIDE, LAST, NUM_POSITIONS
from services.recognizer.features import HOP_S
from shared.phones import SILENCE, UNIT_INDEX, UNITS

_SIL = UNIT_INDEX[SILENCE]
_PRIOR_COUNT = 10.0  # n0
_CONNECTED_UNITS = 8  # a recording of fewer units is a word, not connected speech
_WORD_WEIGHT = 0.02
_UNSEEN_FRAMES, _UNSEEN_SPREAD = 10.0, 5.0  # of a unit that no recording has


@dataclass(frozen=True, slots=True)
class AlignedUnit:
    """A unit with its first frame and the frame after its last."""

    unit: int
    start: int
    end: int


def positions_of(units: Sequence[int]) -> list[int]:
    """Position of each unit between the pauses around it; a pause's own is within the recording."""
    positions = []
    for number, unit in enumerate(units):
        before = units[number - 1] if number else None
        after = units[number + 1] if number + 1 < len(units) else None
        edges = (None,) if unit == _SIL else (None, _SIL)
        positions.append(LAST if after in edges else FIRST if before in edges else INSIDE)
    return positions


class UnitDurations:
    """Collects weighted durations of aligned units."""

    def __init__(self) -> None:
        self._sums = np.zeros((3, NUM_POSITIONS, len(UNITS)))  # of 1, frames and frames^2

    def add(self, aligned: Sequence[AlignedUnit], weight: float) -> None:
        """Take the units of one recording, pauses included, in order."""
        positions = positions_of([unit.unit for unit in aligned])
        if sum(unit.unit != _SIL for unit in aligned) < _CONNECTED_UNITS:
            weight *= _WORD_WEIGHT
        for position, unit in zip(positions, aligned, strict=True):
            frames = unit.end - unit.start
            self._sums[:, position, unit.unit] += (weight, weight * frames, weight * frames**2)

    def mean_and_spread_s(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and standard deviation of the durations, each of shape (3, 60), in seconds."""
        unseen = (1.0, _UNSEEN_FRAMES, _UNSEEN_FRAMES**2 + _UNSEEN_SPREAD**2)
        of_units = self._sums.sum(axis=1) + 1e-6 * np.array(unseen)[:, None]
        prior = _PRIOR_COUNT * of_units / of_units[0]
        count, total, squares = self._sums + prior[:, None, :]
        mean = total / count
        spread = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
        return (HOP_S * mean).astype(np.float32), (HOP_S * spread).astype(np.float32)
