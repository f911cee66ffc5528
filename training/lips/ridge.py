"""The linear half of the lip model: ridge regression on the components of the last positions.

Source: Hoerl and Kennard 1970, "Ridge regression: biased estimation for nonorthogonal problems".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Array = NDArray[np.float64]

HISTORY = 8  # positions: 160 ms
RIDGE = 0.5  # weight of zero, fraction of the positions
_TINY = 1e-9


def history_of(components: NDArray[np.floating]) -> Floats:
    """Return the last components of each position, oldest first, and a 1.

    The shape changes from (positions, components) to (positions, HISTORY * components + 1).
    """
    num_positions = len(components)
    padded = np.pad(components.astype(np.float32, copy=False), ((HISTORY - 1, 0), (0, 0)))
    shifted = [padded[delay : delay + num_positions] for delay in range(HISTORY)]
    return np.concatenate([*shifted, np.ones((num_positions, 1), np.float32)], axis=1)


def fit_ridge(histories: Sequence[Floats], targets: Sequence[Floats]) -> Array:
    """Fit targets, (positions, delays, outputs), to histories, (positions, n), of stretches.

    Targets may be NaN. A position counts for an output if its targets are known for all delays.
    Returns the weights, (n, delays, outputs).
    """
    history, target = np.concatenate(list(histories)), np.concatenate(list(targets))
    known = ~np.isnan(target).any(axis=1)  # (positions, outputs)
    weights = np.zeros((history.shape[1], *target.shape[1:]))
    by_rows: dict[bytes, list[int]] = {}  # outputs that are known at the same positions
    for output in range(known.shape[1]):
        by_rows.setdefault(known[:, output].tobytes(), []).append(output)
    for outputs in by_rows.values():
        rows = known[:, outputs[0]]
        if rows.any():
            columns = target[rows][:, :, outputs].reshape(rows.sum(), -1)
            solved = _solve(history[rows], columns)
            weights[:, :, outputs] = solved.reshape(len(weights), -1, len(outputs))
    return weights


def _solve(histories: Floats, targets: Floats) -> Array:
    """Solve one ridge regression; the weight of the constant, the last column, is free."""
    ridge = np.full(histories.shape[1], RIDGE * len(histories))
    ridge[-1] = _TINY
    products = (histories.T @ histories).astype(np.float64)
    with_targets = (histories.T @ targets).astype(np.float64)
    return np.linalg.solve(products + np.diag(ridge), with_targets).astype(np.float64)
