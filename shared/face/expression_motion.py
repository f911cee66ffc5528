"""Shows requested expressions on a speaking or resting face.

Expressions ease in, stay for a time and fade, smoothed by a two-pole filter. Brows, lids, cheeks
and mouth corners are added to the speech. Lips that are closed for speech stay closed:

======  ====================================================  ========  =====
symbol  meaning                                               unit      shape
======  ====================================================  ========  =====
g       gap between the lips in speech                        FAP       (6,)
d       change of the gap by the expression                   FAP       (6,)
c       upward movement of both lips by the expression        FAP       (6,)
a       weight of the expression on the lips, 0 to 1          1         (6,)
======  ====================================================  ========  =====

    g' = g + a d    min(20 - g, 0) <= a d <= max(900 - g, 0)
    both lips move up by c if c > 0, else by a c

``a`` is 0 where the gap is at most 20 or the lower lip is this close to its closure (f), and 1 from
80 upwards. Without speech, the expression moves the lips fully: ``a`` is 1. When speech starts,
``a`` falls again.
"""

from collections.abc import Mapping

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import LOWER_LIP_FAPS, NUM_FAPS, UPPER_LIP_FAPS
from kouxing.shared.face.high_level_faps import EXPRESSION_NAMES, EXPRESSIONS
from kouxing.shared.face.shapes import ARKIT
from kouxing.shared.face.smoothing import TwoPoleFilter, smoothing_gain

CLOSED = 20.0  # largest gap of a closure, FAP units
OPEN = 80.0  # from this gap upwards, lips have the width of an open mouth
JAW = 3 - 1
UPPER, LOWER = np.array([UPPER_LIP_FAPS, LOWER_LIP_FAPS]) - 1

_VISIBLE = 0.01  # FAP units
_EASE_S, _FADE_S = 0.09, 0.3  # time constants of each filter pole, at the start and the end
_FREE_S = 0.15  # time constant of the rise of the weight on the lips after speech
_BIND_S = 0.04  # time in which it falls when speech starts
_ARKIT_EXPRESSIONS = {
    ExpressionName.SMILE: ("mouthSmileLeft", "mouthSmileRight"),
    ExpressionName.BROW_UP: ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    ExpressionName.BROW_DOWN: ("browDownLeft", "browDownRight"),
    ExpressionName.SQUINT: ("eyeSquintLeft", "eyeSquintRight"),
}
EXPRESSION_FAPS: dict[str, Floats] = {  # (68,) at full strength
    **dict(zip(EXPRESSION_NAMES[1:], EXPRESSIONS[1:], strict=True)),
    **{
        name: ARKIT.basis[[ARKIT.names.index(shape) for shape in shapes]].sum(axis=0)
        for name, shapes in _ARKIT_EXPRESSIONS.items()
    },
}
_WIDEST, _WIDEST_JAW = 900.0, 500.0  # limits of opening by an expression, FAP units
_LIPS = np.concatenate([UPPER, LOWER, [JAW]])


class ExpressionMotion:
    """The current expressions of the face. ``ease_s`` is the time constant of each filter pole."""

    def __init__(self, ease_s: float = _EASE_S) -> None:
        self._ease_s = ease_s
        self._goal: Floats = np.zeros(NUM_FAPS, np.float32)
        self._shown = TwoPoleFilter(self._goal)
        self._remaining_s = 0.0  # time until the expressions fade
        self.lip_weight = 1.0  # lowest weight on the lips: 1 without speech, 0 in speech
        self._is_shown = False

    def show(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Replace the current expressions for a time; without strengths, they fade now.

        Unknown names are ignored.
        """
        goal = np.zeros(NUM_FAPS, np.float32)
        for name, strength in strengths.items():
            if name in EXPRESSION_FAPS:
                goal += np.float32(strength) * EXPRESSION_FAPS[name]
        self.show_faps(goal, hold_s if strengths else 0.0)

    def show_faps(self, goal: Floats, hold_s: float) -> None:
        """Replace the current expressions with FAPs, (68,), for a time."""
        self._goal, self._remaining_s = goal, hold_s

    def add(self, faps: Floats, step_s: float, *, is_speaking: bool) -> None:
        """Add the expressions to a frame, FAPs (68,), in place."""
        is_held = self._remaining_s > 0.0
        self._remaining_s -= step_s
        if is_speaking:
            self.lip_weight = max(self.lip_weight - step_s / _BIND_S, 0.0)
        else:
            self.lip_weight += (1.0 - self.lip_weight) * smoothing_gain(step_s, _FREE_S)
        if is_held or self._is_shown:
            goal = is_held * self._goal
            shown = self._shown.step(goal, step_s, self._ease_s if is_held else _FADE_S)
            mix_expression(faps, shown, self.lip_weight)
            self._is_shown = bool(np.abs(shown).max() > _VISIBLE)


def mix_expression(faps: Floats, expression: Floats, lip_weight: float) -> None:
    """Add an expression (68,) to a face (68,), in place; ``lip_weight`` is the least ``a``."""
    gap = -(faps[UPPER] + faps[LOWER])
    room = np.minimum(np.minimum(gap, -faps[LOWER]), OPEN) - CLOSED
    room = np.concatenate([np.minimum(room[:3], room[3:])] * 2)  # inner and outer lip
    apart = np.maximum(room / (OPEN - CLOSED), lip_weight)
    change = -(expression[UPPER] + expression[LOWER])
    change = np.maximum(apart * change, np.minimum(CLOSED - gap, 0.0))
    change = np.minimum(change, np.maximum(_WIDEST - gap, 0.0))
    upwards = (expression[LOWER] - expression[UPPER]) / 2.0
    upwards = np.where(upwards > 0.0, upwards, apart * upwards)
    upper, lower = -upwards - change / 2.0, upwards - change / 2.0
    jaw = min(apart[0] * expression[JAW], max(_WIDEST_JAW - faps[JAW], 0.0))
    rest = expression.copy()
    rest[_LIPS] = np.concatenate([upper, lower, [jaw]])
    faps += rest
