"""Confusions: which phones are recognised as which."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.corpora.scoring import matched_pairs
from kouxing.shared.phones.inventory import PhoneInventory

# Visemes of consonants made at the lips (b p m, f), and of those that sound alike but are made with
# the tongue (d t n, g k h).
_LABIALS, _LINGUALS = {"b", "f"}, {"d", "g"}


class Confusions:
    """Counts of reference phones (rows) against recognised phones (columns).

    The row of silence counts insertions, its column deletions.
    """

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self.counts: NDArray[np.int64] = np.zeros((len(inventory), len(inventory)), np.int64)

    def add(self, reference: Sequence[str], recognized: Sequence[str]) -> None:
        """Count the phones of a recording."""
        index, silence = self._inventory.index, self._inventory.silence
        for i, j in matched_pairs(reference, recognized):
            row = silence if i is None else reference[i]
            column = silence if j is None else recognized[j]
            self.counts[index[row], index[column]] += 1

    def most_frequent(self, num: int = 15) -> list[dict[str, object]]:
        """Return the most frequent confusions with their counts."""
        wrong = self.counts.copy()
        np.fill_diagonal(wrong, 0)
        order = np.argsort(wrong, axis=None)[::-1][:num]
        phones = self._inventory.phones
        return [
            {
                "reference": phones[row],
                "recognized": phones[column],
                "count": int(wrong[row, column]),
            }
            for row, column in zip(*np.unravel_index(order, wrong.shape), strict=True)
        ]

    def at_lips(self) -> dict[str, float | None]:
        """Measure how the consonants made at the lips are recognised: viewers see them being shut.

        Returns
        -------
        dict
            ``recall``: fraction of those spoken in whose place another one, or the same, is
            recognised; ``precision``: fraction of those recognised in whose place one is spoken;
            ``as_lingual`` and ``for_lingual``: fractions of the same with one made with the tongue
            instead. None if there is none.
        """
        labial, lingual = self._with_viseme(_LABIALS), self._with_viseme(_LINGUALS)
        spoken, recognized = self.counts[labial], self.counts[:, labial]

        def fraction(part: NDArray[np.int64], whole: NDArray[np.int64]) -> float | None:
            return int(part.sum()) / int(whole.sum()) if whole.any() else None

        return {
            "recall": fraction(spoken[:, labial], spoken),
            "precision": fraction(recognized[labial], recognized),
            "as_lingual": fraction(spoken[:, lingual], spoken),
            "for_lingual": fraction(recognized[lingual], recognized),
        }

    def _with_viseme(self, visemes: set[str]) -> NDArray[np.bool_]:
        """Tell of each phone whether it begins with one of the visemes."""
        inventory = self._inventory
        return np.array([inventory.visemes[phone][0][0] in visemes for phone in inventory.phones])


def draw_confusions(figures: Mapping[str, Any], path: Path) -> None:
    """Draw the confusion matrix of :func:`evaluation.recognizer.error_rates.evaluate_recognizer`.

    Rows are normalised. Silence, as ``-``, is the last row (insertions) and column (deletions).

    Raises
    ------
    UserError
        If the picture cannot be written.
    """
    phones, silence = figures["phones"], figures["silence"]
    order = sorted(range(len(phones)), key=lambda number: phones[number] == silence)
    names = [phones[number] if phones[number] != silence else "-" for number in order]
    counts = np.array(figures["confusions"])[np.ix_(order, order)]
    rates = counts / np.maximum(1, counts.sum(axis=1, keepdims=True))
    figure = new_figure(11.0, 10.0)
    axes = figure.add_subplot()
    picture = axes.imshow(rates, cmap="viridis", vmin=0, vmax=1)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xlabel("recognised (-: nothing)")
    axes.set_ylabel("reference (-: nothing)")
    figure.colorbar(picture, label="fraction of the reference phone", shrink=0.8)
    save_figure(figure, path)
