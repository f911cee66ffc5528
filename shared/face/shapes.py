"""Faces as weights of shapes: ARKit's 52, Oculus' 15 visemes, VRM 1's expressions; and back.

Both directions are linear in their bases: a face of weights ``w`` is the FAPs

    f = A^T w                                     (1)

and the weights nearest to given FAPs are the non-negative least-squares solution

    w = argmin_{0 <= w <= 1} |D (A^T w - f)|^2 + r^2 |w|^2             (2)

======  ======================================================  ========  ========
symbol  meaning                                                 unit      shape
======  ======================================================  ========  ========
A       FAPs of each shape at weight 1                          FAP       (N, 68)
D       what one FAP unit does: the travel of its feature       mm        (72, 68)
        point, and 1.5 times how far four pairs of points part
        the lips, for closed lips are to stay closed
r       keeps shapes that nearly agree from rising together     mm        1
======  ======================================================  ========  ========

What a set has no shape for counts for none of them: the head's turn (FAPs 48 to 50) for all, FAPs 1
and 2 (``high_level`` turns these into others), and for the visemes whatever is no mouth.

``arkit.tsv`` was measured on MakeHuman's face units (CC0); the
visemes are those of FAP 1, whose fifteen entries are Oculus' fifteen. VRM's vowels are the visemes
aa, ih, ou, E and oh, its blinks and looks both eyes' of ARKit. VRM adds "blink" to "blinkLeft" and
"blinkRight", so what both eyes close by is in "blink", and only what one closes further in its own;
its looks leave the lids to the blinks. The tongue counts half there: it tells vowels apart, but
consonants, which have no shape, lift it, too.

Equation (2) is solved exactly, by block pivoting (J. Kim, H. Park, "Fast nonnegative matrix
factorization", SIAM J. Scientific Computing 33(6), 2011; here with two bounds): guess which
weights are 0, which 1 and which in between, solve for these, and move those that break a bound or
lean away from theirs to the other side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.high_level import VISEMES, fap_table
from kouxing.shared.face.shape_names import ShapeSetName

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# lengths of an average face in mm; the eyeball's angles count by the way of the pupil
_FAPU_MM = {"MNS": 17.0, "MW": 48.0, "ENS": 45.0, "ES": 58.0, "IRISD": 9.0}
_EYE_RADIUS_MM = 12.0
_RIDGE_MM = 1.0
_PATIENCE = 3  # exchanges of many weights that may fail to help, before they move one by one
_ROUNDING = 1e-9
_FACING_LIPS = ((4, 5), (51, 52), (55, 57), (56, 58))  # FAPs of the upper and of the lower lip
_GAP_WEIGHT = 1.5
_LIDS = slice(18, 22)  # FAPs 19 to 22
_TONGUE = slice(43, 47)  # FAPs 44 to 47


def _effect_mm() -> Float64:
    """D of equation (2)."""
    lengths = [_FAPU_MM.get(fap.fapu, 0.0) / FAP_UNITS_PER_FAPU for fap in FAPS]
    travel = np.diag([mm or _EYE_RADIUS_MM * RADIANS_PER_ANGLE_UNIT for mm in lengths])
    gaps = [-travel[upper - 1] - travel[lower - 1] for upper, lower in _FACING_LIPS]
    return np.concatenate([travel, _GAP_WEIGHT * np.array(gaps)])


_EFFECT_MM = _effect_mm()


class ShapeSet:
    """Named shapes of a face.

    Parameters
    ----------
    names
        Of the N shapes.
    basis
        FAPs (N, 68) of each at weight 1.
    solved
        What takes their place in equation (2), (N, 68), with zeros for a shape that it leaves out.
    effect_mm
        D of equation (2).
    finish
        Sets, in place, the weights (N,) of shapes that equation (2) leaves out.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        basis: Float32,
        solved: Float32 | None = None,
        effect_mm: Float64 = _EFFECT_MM,
        finish: Callable[[Float32], None] = lambda _weights: None,
    ) -> None:
        self.names = names
        self.basis = basis
        self._finish = finish
        matrix = (basis if solved is None else solved).astype(np.float64) @ effect_mm.T
        self._gram = matrix @ matrix.T + _RIDGE_MM**2 * np.eye(len(names))  # (N, N)
        self._right = matrix @ effect_mm  # (N, 68): times f, the right-hand side
        self._unbounded = np.linalg.solve(self._gram, self._right)

    def faps(self, weights: Float32) -> Float32:
        """Add shapes of the given weights (N,) up to FAPs (68,); equation (1)."""
        faps: Float32 = np.asarray(weights, dtype=np.float32) @ self.basis
        return faps

    def weights(self, faps: Float32) -> Float32:
        """Find the shapes that together look most like a face; equation (2).

        Parameters
        ----------
        faps
            Facial animation parameters (68,), FAP units.

        Returns
        -------
        Weights (N,) from 0 to 1 in the order of ``names``.

        Raises
        ------
        ValueError
            If ``faps`` has another shape.
        """
        if faps.shape != (NUM_FAPS,):
            raise ValueError(f"expected FAPs of shape ({NUM_FAPS},), got {faps.shape}")
        weights = self._solve(faps.astype(np.float64)).astype(np.float32)
        self._finish(weights)
        return weights

    def _solve(self, faps: Float64) -> Float64:
        right = self._right @ faps
        guess = self._unbounded @ faps
        at_one = guess >= 1.0
        free = (guess > 0.0) & ~at_one
        fewest, patience = len(right) + 1, _PATIENCE
        while True:
            weights = at_one.astype(np.float64)
            inner = np.flatnonzero(free)
            rows = self._gram[inner]
            weights[inner] = np.linalg.solve(rows[:, inner], right[inner] - rows @ weights)
            lean = right - self._gram @ weights  # where a smaller misfit lies
            below, above = free & (weights < -_ROUNDING), free & (weights > 1.0 + _ROUNDING)
            released = ~free & (np.where(at_one, -lean, lean) > _ROUNDING)
            wrong = np.flatnonzero(below | above | released)
            if len(wrong) == 0:
                return np.clip(weights, 0.0, 1.0)
            if len(wrong) < fewest:
                fewest, patience = len(wrong), _PATIENCE
            elif patience:
                patience -= 1
            else:  # the last of them alone: that ends surely
                wrong = wrong[-1:]
            free[wrong] = released[wrong]
            at_one[wrong] = above[wrong]


def _arkit() -> ShapeSet:
    rows, basis = fap_table("arkit.tsv")
    names = tuple(row["shape"] for row in rows)
    # A shape to the left and that to the right would rise together for what they have in common;
    # half of their difference stands for both.
    solved = basis.copy()
    for name in ("jaw", "mouth"):
        left, right = (names.index(name + side) for side in ("Left", "Right"))
        half = (basis[left] - basis[right]) / 2
        solved[left], solved[right] = half, -half
    return ShapeSet(names, basis, solved)


def _oculus() -> ShapeSet:
    def fill_silence(weights: Float32) -> None:
        weights[0] = max(0.0, 1.0 - float(weights.sum()))

    names = "sil PP FF TH DD kk CH SS nn RR aa E ih oh ou".split()
    return ShapeSet(tuple(names), VISEMES, finish=fill_silence)


def _vrm() -> ShapeSet:
    vowels = {"aa": "aa", "ih": "ih", "ou": "ou", "ee": "E", "oh": "oh"}
    eyes = {
        "blink": ("eyeBlinkLeft", "eyeBlinkRight"),
        "blinkLeft": ("eyeBlinkLeft",),
        "blinkRight": ("eyeBlinkRight",),
        "lookUp": ("eyeLookUpLeft", "eyeLookUpRight"),
        "lookDown": ("eyeLookDownLeft", "eyeLookDownRight"),
        "lookLeft": ("eyeLookOutLeft", "eyeLookInRight"),
        "lookRight": ("eyeLookInLeft", "eyeLookOutRight"),
    }
    basis = np.concatenate(
        [
            OCULUS.basis[[OCULUS.names.index(name) for name in vowels.values()]],
            [
                ARKIT.basis[[ARKIT.names.index(name) for name in each]].sum(0)
                for each in eyes.values()
            ],
        ]
    )
    both = len(vowels)  # the row of "blink"
    basis[both + 3 :, _LIDS] = 0.0
    solved = basis.copy()
    solved[both] = 0.0

    def join_blinks(weights: Float32) -> None:
        weights[both] = weights[both + 1 : both + 3].min()
        weights[both + 1 : both + 3] -= weights[both]

    effect_mm = _EFFECT_MM.copy()
    effect_mm[_TONGUE] /= 2
    return ShapeSet((*vowels, *eyes), basis, solved, effect_mm, join_blinks)


ARKIT = _arkit()  # 52
OCULUS = _oculus()  # 15; "sil" is what the others leave of 1
VRM = _vrm()  # 12
SHAPE_SETS: Mapping[str, ShapeSet] = {
    ShapeSetName.ARKIT: ARKIT,
    ShapeSetName.OCULUS: OCULUS,
    ShapeSetName.VRM: VRM,
}
