"""ARKit's 52 blend shapes and Oculus' 15 visemes as sums of FAPs, and back.

Both directions are linear in their bases: a face of blend-shape weights ``w`` is the FAPs

    f = A^T w                                     (1)

and the weights nearest to given FAPs are the non-negative least-squares solution

    w = argmin_{0 <= w <= 1} |D (A^T w - f)|^2 + r^2 |w|^2             (2)

======  ======================================================  ========  ========
symbol  meaning                                                 unit      shape
======  ======================================================  ========  ========
A       FAPs of each shape at weight 1                          FAP       (N, 68)
D       travel of a FAP's feature point by one FAP unit         mm        (68,)
r       keeps shapes that nearly agree from rising together     mm        1
======  ======================================================  ========  ========

``arkit.tsv`` was measured on MakeHuman's face units (CC0), see ``training.heads.arkit_table``; the
visemes are those of FAP 1, whose fifteen entries are Oculus' fifteen.
Equation (2) is solved by A. Beck, M. Teboulle, "A fast iterative shrinkage-thresholding algorithm",
SIAM J. Imaging Sciences 2(1), 2009, whose shrinkage is here the clipping to 0 and 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from shared.face.high_level import VISEMES, fap_table

Float32 = NDArray[np.float32]

# lengths of an average face in mm; the eyeball's angles count by the way of the pupil
_FAPU_MM = {"MNS": 17.0, "MW": 48.0, "ENS": 45.0, "ES": 58.0, "IRISD": 9.0}
_EYE_RADIUS_MM = 12.0
_SHAPELESS = (1, 2, 48, 49, 50)  # FAPs that no shape expresses
_RIDGE_MM = 1.0
_STEPS = 120  # to solve equation (2); then the weights are right to 0.02


def _read() -> tuple[tuple[str, ...], Float32]:
    rows, values = fap_table("arkit.tsv")
    return tuple(row["shape"] for row in rows), values


def _travel_mm() -> NDArray[np.float64]:
    """D of equation (2)."""
    travel = np.zeros(NUM_FAPS)
    for fap in FAPS:
        if fap.number not in _SHAPELESS:
            length = _FAPU_MM.get(fap.fapu, 0.0) / FAP_UNITS_PER_FAPU
            travel[fap.number - 1] = length or _EYE_RADIUS_MM * RADIANS_PER_ANGLE_UNIT
    return travel


ARKIT_NAMES, ARKIT = _read()  # (52,), (52, 68)
OCULUS_NAMES = (
    "sil", "PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "ih", "oh", "ou",
)  # fmt: skip
_TRAVEL = _travel_mm()


def arkit_faps(weights: Float32) -> Float32:
    """Add ARKit shapes of the given weights (52,) up to FAPs (68,); equation (1)."""
    faps: Float32 = np.asarray(weights, dtype=np.float32) @ ARKIT
    return faps


def arkit_weights(faps: Float32) -> Float32:
    """Find the ARKit shapes that look most like a face.

    Parameters
    ----------
    faps
        Facial animation parameters (68,), FAP units; FAPs 1 and 2 and the head's turn (48 to 50)
        are left out.

    Returns
    -------
    Weights (52,) from 0 to 1 in the order of ``ARKIT_NAMES``; equation (2).
    """
    return _weights(_ARKIT_SYSTEM, faps)


def oculus_weights(faps: Float32) -> Float32:
    """Find the Oculus visemes that look most like a mouth.

    Parameters
    ----------
    faps
        Facial animation parameters (68,), FAP units; only jaw, lips and tongue count.

    Returns
    -------
    Weights (15,) from 0 to 1 in the order of ``OCULUS_NAMES``; "sil" is what the others leave of 1.
    """
    weights = np.zeros(len(OCULUS_NAMES), np.float32)
    weights[1:] = _weights(_OCULUS_SYSTEM, faps)
    weights[0] = max(0.0, 1.0 - float(weights.sum()))
    return weights


class _System:
    """The least-squares problem of equation (2) by its normal equations."""

    def __init__(self, shapes: Float32, travel: NDArray[np.float64]) -> None:
        matrix = (shapes * travel).astype(np.float64)  # (N, 68)
        gram = matrix @ matrix.T + _RIDGE_MM**2 * np.eye(len(shapes))
        # fewer steps are needed for shapes of one size: w = scale x with 0 <= x <= 1 / scale
        self.scale = 1 / np.sqrt(np.diag(gram))
        self.gram = gram * np.outer(self.scale, self.scale)
        self.right = self.scale[:, None] * matrix * travel  # (N, 68): times f, the right-hand side
        step = 1 / np.linalg.eigvalsh(self.gram)[-1]
        self.gram, self.right = self.gram * step, self.right * step


def _weights(system: _System, faps: Float32) -> Float32:
    if faps.shape != (NUM_FAPS,):
        raise ValueError(f"expected FAPs of shape ({NUM_FAPS},), got {faps.shape}")
    right = system.right @ np.asarray(faps, dtype=np.float64)
    highest = 1 / system.scale
    weights = ahead = np.zeros(len(right))
    momentum = 1.0
    for _ in range(_STEPS):
        moved = np.minimum(np.maximum(ahead - system.gram @ ahead + right, 0.0), highest)
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        ahead = moved + (momentum - 1) / following * (moved - weights)
        weights, momentum = moved, following
    return (weights * system.scale).astype(np.float32)


def _without_common_part(shapes: Float32) -> Float32:
    """Reduce each pair of shapes to the left and to the right to half of its difference.

    Else both would rise together for what they have in common.
    """
    shapes = shapes.copy()
    for name in ("jaw", "mouth"):
        left, right = (ARKIT_NAMES.index(name + side) for side in ("Left", "Right"))
        half = (shapes[left] - shapes[right]) / 2
        shapes[left], shapes[right] = half, -half
    return shapes


_ARKIT_SYSTEM = _System(_without_common_part(ARKIT), _TRAVEL)
_MOUTH = np.abs(VISEMES).max(axis=0) > 0
_OCULUS_SYSTEM = _System(VISEMES[1:], np.where(_MOUTH, _TRAVEL, 0.0))
