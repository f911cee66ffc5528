"""What clients choose of expressions: their names, strengths, and for how long they stay."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from kouxing.shared.errors import UserError

MIN_EXPRESSIVENESS, MAX_EXPRESSIVENESS = 0.5, 2.0  # 1: as the lip model moves the mouth
MAX_HOLD_S = 3600.0
DEFAULT_HOLD_S = 3.0  # that expressions stay before they fade


class ExpressionName(StrEnum):
    """What a face can show beside speech."""

    JOY = "joy"  # these six are FAP 2's, in its order
    SADNESS = "sadness"
    ANGER = "anger"
    FEAR = "fear"
    DISGUST = "disgust"
    SURPRISE = "surprise"
    SMILE = "smile"  # these four are both sides of ARKit's shapes
    BROW_UP = "brow_up"
    BROW_DOWN = "brow_down"
    SQUINT = "squint"


def check_expressions(strengths: Mapping[str, object], hold_s: object) -> None:
    """Check what a user asks for.

    Raises
    ------
    UserError
        If there is no such expression, or a strength or the time is out of range.
    """
    for name, strength in strengths.items():
        if name not in [*ExpressionName]:
            raise UserError(f"there is no expression {name!r}; use {', '.join(ExpressionName)}")
        if not _is_number(strength, 1.0):
            raise UserError(f"{name} is {strength}; give a strength from 0 to 1")
    if not _is_number(hold_s, MAX_HOLD_S):
        raise UserError(f"hold_s is {hold_s}; give 0 to {MAX_HOLD_S:g} seconds")


def check_expressiveness(amount: object) -> float:
    """Return how much the mouth is to move, if that is in range.

    Raises
    ------
    UserError
        If it is not.
    """
    if not _is_number(amount, MAX_EXPRESSIVENESS, MIN_EXPRESSIVENESS):
        raise UserError(
            f"expressiveness is {amount}; give {MIN_EXPRESSIVENESS:g} to {MAX_EXPRESSIVENESS:g}"
        )
    return float(amount)  # type: ignore[arg-type]


def _is_number(value: object, highest: float, lowest: float = 0.0) -> bool:
    return type(value) in (int, float) and lowest <= value <= highest  # type: ignore[operator]
