"""Expressions that a client asks for, mixed with speech.

They ease in, stay for a while and fade, each by two filters in a row: no corner in the curve.
Brows, lids, cheeks and the corners of the mouth are added to those of speech. Lips that speech has
shut stay shut:

======  ====================================================  ========  =====
symbol  meaning                                               unit      shape
======  ====================================================  ========  =====
g       gap of two lips, of speech                            FAP       (6,)
d       change of that gap by the expression                  FAP       (6,)
c       movement of both lips upwards, by the expression      FAP       (6,)
a       how far the lips are free, 0 to 1                     1         (6,)
======  ====================================================  ========  =====

    g' = g + a d    min(20 - g, 0) <= a d <= max(900 - g, 0)
    both lips move up by c if c > 0, else by a c

``a`` is 0 where the gap is at most 20, or the lower lip is that near to where it is shut (f), and 1
from 80 on. While nobody speaks all lips are free; they are bound again when its sound begins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.expressiveness import JAW, LOWER, OPEN, SHUT, UPPER
from kouxing.services.synthesizer.modifiers.modifier import Moment
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.high_level import EXPRESSION_NAMES, EXPRESSIONS
from kouxing.shared.face.shapes import ARKIT

_EASE_S, _FADE_S = 0.09, 0.3  # time constants of each of two filters
_FREE_S, _BIND_S = 0.15, 0.04  # time constant and time after which lips are free, and bound
_GESTURES = {
    ExpressionName.SMILE: ("mouthSmileLeft", "mouthSmileRight"),
    ExpressionName.BROW_UP: ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    ExpressionName.BROW_DOWN: ("browDownLeft", "browDownRight"),
    ExpressionName.SQUINT: ("eyeSquintLeft", "eyeSquintRight"),
}
EXPRESSION_FAPS: dict[str, NDArray[np.float32]] = {  # (68,) at full strength
    **dict(zip(EXPRESSION_NAMES[1:], EXPRESSIONS[1:], strict=True)),
    **{
        name: ARKIT.basis[[ARKIT.names.index(shape) for shape in shapes]].sum(axis=0)
        for name, shapes in _GESTURES.items()
    },
}
_WIDEST, _WIDEST_JAW = 900.0, 500.0  # that an expression opens the mouth, FAP units
_LIPS = np.concatenate([UPPER, LOWER, [JAW]])


class Expression:
    """What the face shows beside speech; at rest it changes nothing."""

    def __init__(self) -> None:
        self._goal = self._halfway = self._shown = np.zeros(NUM_FAPS, np.float32)
        self._held_s = 0.0  # for which it is still held
        self._free = 1.0

    def show(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions in place of those before, for a time; none: they fade now."""
        self._goal = np.zeros(NUM_FAPS, np.float32)
        for name, strength in strengths.items():
            self._goal += np.float32(strength) * EXPRESSION_FAPS[name]
        self._held_s = hold_s if strengths else 0.0

    @property
    def free(self) -> float:
        """How far lips are free of speech: 1 while nobody speaks, soon 0 when somebody does."""
        return self._free

    def apply(self, faps: NDArray[np.float32], moment: Moment) -> None:
        """Add the expression to a frame, FAPs (68,), in place."""
        is_held = self._held_s > 0.0
        self._held_s -= moment.step_s
        share = -math.expm1(-moment.step_s / (_EASE_S if is_held else _FADE_S))
        self._halfway = self._halfway + share * (is_held * self._goal - self._halfway)
        self._shown = self._shown + share * (self._halfway - self._shown)
        if moment.is_speaking:
            self._free = max(self._free - moment.step_s / _BIND_S, 0.0)
        else:
            self._free -= (1.0 - self._free) * math.expm1(-moment.step_s / _FREE_S)
        if self._shown.any():
            mix(faps, self._shown, self._free)


def mix(faps: NDArray[np.float32], expression: NDArray[np.float32], free: float) -> None:
    """Add an expression (68,) to a face (68,), in place; ``free`` is the least ``a``."""
    gap = -(faps[UPPER] + faps[LOWER])
    room = np.minimum(np.minimum(gap, -faps[LOWER]), OPEN) - SHUT
    room = np.tile(np.minimum(room[:3], room[3:]), 2)  # the inner lip and the outer one
    apart = np.maximum(room / (OPEN - SHUT), free)
    change = -(expression[UPPER] + expression[LOWER])
    change = np.clip(apart * change, np.minimum(SHUT - gap, 0.0), np.maximum(_WIDEST - gap, 0.0))
    upwards = (expression[LOWER] - expression[UPPER]) / 2.0
    upwards = np.where(upwards > 0.0, upwards, apart * upwards)
    upper, lower = -upwards - change / 2.0, upwards - change / 2.0
    jaw = min(apart[0] * expression[JAW], max(_WIDEST_JAW - faps[JAW], 0.0))
    rest = expression.copy()
    rest[_LIPS] = np.concatenate([upper, lower, [jaw]])
    faps += rest
