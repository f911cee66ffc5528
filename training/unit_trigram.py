"""How likely a unit is after the two before it.

Source: Witten and Bell 1991, "The zero-frequency problem", as interpolation (Chen and Goodman 1999,
section 2.6): a context seen N times, with T different units after it, is trusted N / (N + T), the
next shorter one for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shared.phones import INITIALS, SILENCE, UNIT_INDEX, UNITS

_SIL = UNIT_INDEX[SILENCE]
_LEAST = 1e-7


def unit_trigram(
    sentences: Sequence[Sequence[int]], *, pause_share: float = 0.05
) -> NDArray[np.float32]:
    """Log probabilities of a unit (last axis) after two units, shape (60, 60, 60).

    Parameters
    ----------
    sentences
        Each one's units, indices into ``shared.phones.UNITS``.
    pause_share
        How often ``sil`` follows a final within a sentence. After ``sil`` a sentence begins anew.

    Returns
    -------
    array
        Rounded to hundredths, so that a model file packs them well.
    """
    num_units = len(UNITS)
    counts = np.zeros((num_units, num_units, num_units))
    for units in sentences:
        said = np.array([_SIL, _SIL, *units, _SIL])
        np.add.at(counts, (said[:-2], said[1:-1], said[2:]), 1.0)
    alone = _interpolated(counts.sum(axis=(0, 1)), np.full(num_units, 1 / num_units))
    after_one = _interpolated(counts.sum(axis=0), alone)
    share = _interpolated(counts, after_one)
    finals = slice(len(INITIALS), _SIL)
    share[:, finals] *= 1 - pause_share
    share[:, finals, _SIL] += pause_share
    share[:, _SIL] = after_one[_SIL]
    log_trigram: NDArray[np.float32] = np.log(np.maximum(share, _LEAST)).round(2).astype(np.float32)
    return log_trigram


def _interpolated(counts: NDArray[np.float64], shorter: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shares of the last axis, mixed with those after a shorter context."""
    total = counts.sum(axis=-1, keepdims=True)
    different = (counts > 0).sum(axis=-1, keepdims=True)
    # a context never seen says nothing
    shares: NDArray[np.float64] = np.where(
        total > 0, (counts + different * shorter) / np.maximum(total + different, 1), shorter
    )
    return shares
