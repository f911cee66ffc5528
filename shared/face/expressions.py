"""Expressions that a client can request: names, strengths and duration."""

from collections.abc import Mapping
from enum import StrEnum

from kouxing.shared.errors import UserError

MIN_EXPRESSIVENESS, MAX_EXPRESSIVENESS = 0.5, 2.0  # 1 leaves the lip model unchanged
MAX_HOLD_S = 3600.0
DEFAULT_HOLD_S = 3.0  # expressions fade after this time


class ExpressionName(StrEnum):
    """Expressions that the face can show in addition to speech."""

    JOY = "joy"  # the first six are FAP 2's expressions, in its order
    SADNESS = "sadness"
    ANGER = "anger"
    FEAR = "fear"
    DISGUST = "disgust"
    SURPRISE = "surprise"
    SMILE = "smile"  # the last four combine the left and right ARKit shapes
    BROW_UP = "brow_up"
    BROW_DOWN = "brow_down"
    SQUINT = "squint"


def check_expressions(strengths: Mapping[str, object], hold_s: object) -> None:
    """Check requested expressions.

    Raises ``UserError`` if an expression is unknown, or a strength or the time is out of range.
    """
    for name, strength in strengths.items():
        if name not in [*ExpressionName]:
            raise UserError(f"unknown expression {name!r}; use {', '.join(ExpressionName)}")
        if not _is_number(strength, 1.0):
            raise UserError(f"expression {name}: strength {strength} is not between 0 and 1")
    if not (_is_number(hold_s, MAX_HOLD_S) and hold_s):
        raise UserError(f"hold_s is {hold_s}; use more than 0, and at most {MAX_HOLD_S:g} seconds")


def _is_number(value: object, highest: float) -> bool:
    return type(value) in (int, float) and 0.0 <= value <= highest  # type: ignore[operator]
