"""Phones to visemes: table 1 of Li et al. 2011."""

from dataclasses import replace

import pytest

from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes, visemes_of
from kouxing.shared.errors import UserError
from tests.lips import INVENTORY


def visemes(symbol: str, next_symbol: str | None) -> tuple[tuple[str, float], ...]:
    return visemes_of(symbol, next_symbol, INVENTORY)


def test_rejects_a_language_with_unknown_visemes() -> None:
    check_visemes(INVENTORY)
    for change in (
        {"visemes": {**INVENTORY.visemes, "a": (("click", 1.0),)}},
        {"before_rounded": {"d": "click"}},
    ):
        with pytest.raises(UserError, match="visemes click; use rest, b"):
            check_visemes(replace(INVENTORY, **change))


@pytest.mark.parametrize(
    ("symbol", "split"),
    [("iao", "i ao"), ("uai", "u ai"), ("iong", "v u"), ("ang", "a"), ("eng", "e"), ("vn", "v ei")],
)
def test_splits_compound_finals(symbol: str, split: str) -> None:
    assert [viseme for viseme, _ in visemes(symbol, None)] == split.split()


def test_initials_are_rounded_only_before_rounded_finals() -> None:
    assert visemes("d", "u") == visemes("t", "uan") == (("d_rounded", 1.0),)
    assert visemes("j", "van") == (("j_rounded", 1.0),)
    assert visemes("d", "i") == visemes("d", None) == (("d", 1.0),)
    assert visemes("b", "u") == (("b", 1.0),)  # no rounded variant
    assert visemes("a", "u") == (("a", 1.0),)
