"""Confusions: which phones are recognized as which."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.scoring import matched_pairs
from kouxing.shared.phones.inventory import PhoneInventory

# Visemes of consonants made with the lips (b p m, f), and of similar ones made with the tongue
# (d t n, g k h).
_LABIALS, _LINGUALS = {"b", "f"}, {"d", "g"}


class Confusions:
    """Counts of reference phones (rows) against recognized phones (columns).

    The row of silence counts insertions, its column deletions.
    """

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._counts: NDArray[np.int64] = np.zeros((len(inventory), len(inventory)), np.int64)

    def add(self, reference: Sequence[str], recognized: Sequence[str]) -> None:
        """Count the phones of a recording."""
        index, silence = self._inventory.index, self._inventory.silence
        for i, j in matched_pairs(reference, recognized):
            row = silence if i is None else reference[i]
            column = silence if j is None else recognized[j]
            self._counts[index[row], index[column]] += 1

    def labials(self) -> dict[str, float | None]:
        """Measure the consonants made with the lips, whose errors viewers can see.

        ``recall`` is the share of the spoken ones recognized as any of them, ``precision`` the
        share of the recognized ones in whose place any of them is spoken. ``as_lingual`` and
        ``for_lingual`` are the same with consonants made with the tongue. None without phones.
        """
        labial, lingual = self._with_viseme(_LABIALS), self._with_viseme(_LINGUALS)
        spoken, recognized = self._counts[labial], self._counts[:, labial]

        def share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> float | None:
            return int(part.sum()) / int(whole.sum()) if whole.any() else None

        return {
            "recall": share(spoken[:, labial], spoken),
            "precision": share(recognized[labial], recognized),
            "as_lingual": share(spoken[:, lingual], spoken),
            "for_lingual": share(recognized[lingual], recognized),
        }

    def _with_viseme(self, visemes: set[str]) -> NDArray[np.bool_]:
        inventory = self._inventory
        return np.array([inventory.visemes[phone][0][0] in visemes for phone in inventory.phones])
