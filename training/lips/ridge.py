"""The linear part of lips from sound: ridge regression on the last positions' components.

Source: Hoerl and Kennard 1970, "Ridge regression: biased estimation for nonorthogonal problems".
Sums of products are kept by speaker, so that leaving a speaker out costs one solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

HISTORY = 8  # positions: 160 ms
RIDGE = 0.5  # weight of zero, share of the positions
_TINY = 1e-9


def history_of(components: NDArray[np.floating]) -> Floats:
    """Return each position's last components, oldest first, and a 1.

    Parameters
    ----------
    components
        A stretch of speech, shape (positions, components).

    Returns
    -------
    NDArray
        Shape (positions, HISTORY * components + 1).
    """
    num_positions = len(components)
    padded = np.pad(components.astype(np.float32, copy=False), ((HISTORY - 1, 0), (0, 0)))
    shifted = [padded[delay : delay + num_positions] for delay in range(HISTORY)]
    return np.concatenate([*shifted, np.ones((num_positions, 1), np.float32)], axis=1)


@dataclass(slots=True)
class Products:
    """Sums of products of histories X and targets Y of some positions."""

    of_histories: Array  # X' X
    with_targets: Array  # X' Y

    @classmethod
    def of(cls, histories: Floats, targets: Floats) -> Products:
        """Sum over positions with targets that are all known."""
        return cls(
            (histories.T @ histories).astype(np.float64),
            (histories.T @ targets).astype(np.float64),
        )

    def __add__(self, other: Products) -> Products:
        return Products(
            self.of_histories + other.of_histories, self.with_targets + other.with_targets
        )

    def __sub__(self, other: Products) -> Products:
        return Products(
            self.of_histories - other.of_histories, self.with_targets - other.with_targets
        )

    def solve(self) -> Array:
        """Return the weights, (columns of X, columns of Y); the last column of X is 1."""
        num_positions = self.of_histories[-1, -1]
        ridge = np.full(len(self.of_histories), RIDGE * num_positions)
        ridge[-1] = _TINY  # the constant is free
        penalised = self.of_histories + np.diag(ridge)
        return np.linalg.solve(penalised, self.with_targets).astype(np.float64)


def fit_ridge(histories: Sequence[Floats], targets: Sequence[Floats]) -> Array:
    """Fit targets that may be unknown (NaN).

    Parameters
    ----------
    histories
        Of each stretch of speech, shape (positions, n).
    targets
        Of each stretch, shape (positions, delays, outputs). A position counts for an output if it
        is known for all delays.

    Returns
    -------
    NDArray
        Weights, (n, delays, outputs).
    """
    joined, wanted = np.concatenate(list(histories)), np.concatenate(list(targets))
    known = ~np.isnan(wanted).any(axis=1)  # (positions, outputs)
    weights = np.zeros((joined.shape[1], *wanted.shape[1:]))
    patterns = [known[:, output].tobytes() for output in range(known.shape[1])]
    for pattern in dict.fromkeys(patterns):
        outputs = [output for output, each in enumerate(patterns) if each == pattern]
        rows = known[:, outputs[0]]
        if rows.any():
            columns = wanted[rows][:, :, outputs].reshape(rows.sum(), -1)
            solved = Products.of(joined[rows], columns).solve()
            weights[:, :, outputs] = solved.reshape(len(weights), -1, len(outputs))
    return weights
