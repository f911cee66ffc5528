"""Converts between FAPs and blendshapes: ARKit's 52, Oculus' 15 visemes, VRM 1's expressions.

Both directions are linear in the basis. A face with weights ``w`` has the FAPs

    f = A^T w                                     (1)

The weights closest to given FAPs are the bounded least-squares solution

    w = argmin_{0 <= w <= 1} |D (A^T w - f)|^2 + r^2 |w|^2             (2)

======  ======================================================  ========  ========
symbol  meaning                                                 unit      shape
======  ======================================================  ========  ========
A       FAPs of each shape at weight 1                          FAP       (N, 68)
D       effect of one FAP unit: travel of its feature point,    mm        (72, 68)
        and 1.5 times the change of four gaps between the
        lips, which keeps closed lips closed
r       ridge: keeps similar shapes from rising together        mm        1
======  ======================================================  ========  ========

Equation (2) ignores FAPs that a set has no shape for: the head rotation (FAPs 48 to 50), FAPs 1 and
2 (``high_level_faps`` expands them), and for the visemes everything outside the mouth.

``arkit.tsv`` was measured on MakeHuman's face units (CC0). Its
column ``live_link`` is the shape's position in Live Link Face. The Oculus visemes are the 15
entries of FAP 1. VRM's vowels are the visemes aa, ih, ou, E and oh; its blinks and looks combine
both eyes of ARKit. In VRM, "blink" holds what both eyes have in common, "blinkLeft" and
"blinkRight" hold only the rest. The looks leave the lids to the blinks. The tongue has half its
weight in VRM: it distinguishes vowels, but consonants also raise it and have no shape.

Equation (2) is solved exactly by block pivoting (J. Kim, H. Park, "Fast nonnegative matrix
factorization", SIAM J. Scientific Computing 33(6), 2011; here with two bounds). Guess which
weights are 0, 1 or free. Solve for the free weights. Then reassign the weights that violate a
bound or an optimality condition, and repeat.
"""

from collections.abc import Callable, Mapping

import numpy as np

from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.high_level_faps import VISEMES, fap_table
from kouxing.shared.face.shape_names import ShapeSetName

# lengths of an average face, mm; an eye's angle counts as the distance that the pupil travels
_FAPU_MM = {"MNS": 17.0, "MW": 48.0, "ENS": 45.0, "ES": 58.0, "IRISD": 9.0}
_EYE_RADIUS_MM = 12.0
_RIDGE_MM = 1.0
_PATIENCE = 3  # block exchanges without progress before single exchanges
_ROUNDING = 1e-9
_FACING_LIPS = ((4, 5), (51, 52), (55, 57), (56, 58))  # FAPs of the upper and the lower lip
_GAP_WEIGHT = 1.5
_LIDS = slice(18, 22)  # FAPs 19 to 22
_TONGUE = slice(43, 47)  # FAPs 44 to 47


def _effect_mm() -> Doubles:
    """Return D of equation (2)."""
    lengths = [_FAPU_MM.get(fap.fapu, 0.0) / FAP_UNITS_PER_FAPU for fap in FAPS]
    travel = np.diag([mm or _EYE_RADIUS_MM * RADIANS_PER_ANGLE_UNIT for mm in lengths])
    gaps = [-travel[upper - 1] - travel[lower - 1] for upper, lower in _FACING_LIPS]
    return np.concatenate([travel, _GAP_WEIGHT * np.array(gaps)])


_EFFECT_MM = _effect_mm()


class ShapeSet:
    """A named set of N blendshapes; ``basis`` holds the FAPs (N, 68) of each shape at weight 1.

    ``solved`` replaces the basis in equation (2); rows of zeros exclude a shape. ``finish`` sets
    the weights (N,) of excluded shapes in place.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        basis: Floats,
        solved: Floats | None = None,
        effect_mm: Doubles = _EFFECT_MM,
        finish: Callable[[Floats], None] = lambda _weights: None,
    ) -> None:
        self.names = names
        self.basis = basis
        self._finish = finish
        matrix = (basis if solved is None else solved).astype(np.float64) @ effect_mm.T
        self.gram = matrix @ matrix.T + _RIDGE_MM**2 * np.eye(len(names))  # (N, N)
        self.right = matrix @ effect_mm  # (N, 68): times f, the right side of equation (2)
        self._unbounded = np.linalg.solve(self.gram, self.right)

    def faps(self, weights: Floats) -> Floats:
        """Return the FAPs (68,) of weights (N,), equation (1)."""
        return np.asarray(weights, dtype=np.float32) @ self.basis

    def weights(self, faps: Floats) -> Floats:
        """Return the weights (N,), 0 to 1, whose face is closest to FAPs (68,); equation (2)."""
        if faps.shape != (NUM_FAPS,):
            raise ValueError(f"expected FAPs of shape ({NUM_FAPS},), got {faps.shape}")
        weights = self._solve(faps.astype(np.float64)).astype(np.float32)
        self._finish(weights)
        return weights

    def _solve(self, faps: Doubles) -> Doubles:
        right = self.right @ faps
        guess = self._unbounded @ faps
        at_one = guess >= 1.0
        free = (guess > 0.0) & ~at_one
        fewest, patience = len(right) + 1, _PATIENCE
        while True:
            weights = at_one.astype(np.float64)
            inner = np.flatnonzero(free)
            rows = self.gram[inner]
            weights[inner] = np.linalg.solve(rows[:, inner], right[inner] - rows @ weights)
            negative_gradient = right - self.gram @ weights
            below, above = free & (weights < -_ROUNDING), free & (weights > 1.0 + _ROUNDING)
            released = ~free & (np.where(at_one, -negative_gradient, negative_gradient) > _ROUNDING)
            wrong = np.flatnonzero(below | above | released)
            if len(wrong) == 0:
                return np.clip(weights, 0.0, 1.0)
            if len(wrong) < fewest:
                fewest, patience = len(wrong), _PATIENCE
            elif patience:
                patience -= 1
            else:  # exchanging only the last one guarantees termination
                wrong = wrong[-1:]
            free[wrong] = released[wrong]
            at_one[wrong] = above[wrong]


def _build_arkit() -> ShapeSet:
    rows, basis = fap_table("arkit.tsv")
    names = tuple(row["shape"] for row in rows)
    # Left and right shapes would both rise for their common part. Half of their difference replaces
    # each of them.
    solved = basis.copy()
    for name in ("jaw", "mouth"):
        left, right = (names.index(name + side) for side in ("Left", "Right"))
        half = (basis[left] - basis[right]) / 2
        solved[left], solved[right] = half, -half
    return ShapeSet(names, basis, solved)


def _build_oculus() -> ShapeSet:
    def fill_silence(weights: Floats) -> None:
        weights[0] = max(0.0, 1.0 - float(weights.sum()))

    names = "sil PP FF TH DD kk CH SS nn RR aa E ih oh ou".split()
    return ShapeSet(tuple(names), VISEMES, finish=fill_silence)


def _build_vrm() -> ShapeSet:
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
                ARKIT.basis[[ARKIT.names.index(name) for name in shapes]].sum(0)
                for shapes in eyes.values()
            ],
        ]
    )
    both = len(vowels)  # the row of "blink"
    basis[both + 3 :, _LIDS] = 0.0
    solved = basis.copy()
    solved[both] = 0.0

    def join_blinks(weights: Floats) -> None:
        weights[both] = weights[both + 1 : both + 3].min()
        weights[both + 1 : both + 3] -= weights[both]

    effect_mm = _EFFECT_MM.copy()
    effect_mm[_TONGUE] /= 2
    return ShapeSet((*vowels, *eyes), basis, solved, effect_mm, join_blinks)


ARKIT = _build_arkit()  # 52
OCULUS = _build_oculus()  # 15; "sil" is 1 minus the sum of the others
VRM = _build_vrm()  # 12
SHAPE_SETS: Mapping[str, ShapeSet] = {
    ShapeSetName.ARKIT: ARKIT,
    ShapeSetName.OCULUS: OCULUS,
    ShapeSetName.VRM: VRM,
}
