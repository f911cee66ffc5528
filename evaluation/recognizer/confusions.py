"""Confusions: which phones are recognised as which."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corpora.figures import new_figure, save_figure
from corpora.scoring import matched_pairs
from shared.phones.inventory import PhoneInventory

_LABIALS = {"b", "f"}  # visemes: b p m, f


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
        """Recall and precision of the consonants made at the lips: viewers see them being shut.

        A consonant counts as found if another one made at the lips is recognised in its place.
        None if there is none.
        """
        inventory = self._inventory
        is_labial = np.array([
            inventory.visemes[phone][0][0] in _LABIALS if phone != inventory.silence else False
            for phone in inventory.phones
        ])  # fmt: skip
        found = int(self.counts[np.ix_(is_labial, is_labial)].sum())
        spoken, recognized = self.counts[is_labial].sum(), self.counts[:, is_labial].sum()
        return {
            "recall": found / int(spoken) if spoken else None,
            "precision": found / int(recognized) if recognized else None,
        }


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
