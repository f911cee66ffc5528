"""Phones to visemes: table 1 of Li et al. 2011."""

from dataclasses import replace

import numpy as np
import pytest

from kouxing.evaluation.lips.full_model import synthesize
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    CLOSURE_FAPS,
    REST,
    VISEME_INDEX,
    VISEMES,
    check_visemes,
    static_targets,
    visemes_of,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.inventory import PhoneInventory
from tests.lips import INVENTORY, phone

pytestmark = pytest.mark.unit

REST_ALL = ((REST, 1.0),)


def visemes(symbol: str, next_symbol: str | None) -> tuple[tuple[str, float], ...]:
    return visemes_of(symbol, next_symbol, INVENTORY)


def test_rejects_a_language_with_unknown_visemes() -> None:
    check_visemes(INVENTORY)
    for change in (
        {"visemes": {**INVENTORY.visemes, "a": (("th", 1.0),)}},
        {"before_rounded": {"d": "th"}},
    ):
        with pytest.raises(UserError, match="visemes th; use rest, b"):
            check_visemes(replace(INVENTORY, **change))


def test_another_language_uses_the_same_visemes() -> None:
    syllables = PhoneInventory(
        language="toy",
        phones=("ta", "pu", "hush"),
        kinds=("vowel", "vowel", "silence"),
        visemes={"ta": (("d", 0.3), ("a", 0.7)), "pu": (("b", 0.5), ("u", 0.5)), "hush": REST_ALL},
        before_rounded={},
        pronounce=lambda _text: [],
    )
    spoken = [
        phone(index, symbol, 0.4 * index, 0.4) for index, symbol in enumerate(("ta", "pu", "hush"))
    ]
    lips = DynamicVisemes(load_parameters(), syllables)
    faps = synthesize(lips, spoken, 80)
    jaw, protrusion = faps[:, 2], faps[:, 16]
    assert jaw[:20].max() > 200.0
    assert np.abs(faps[23:27, [3, 4]]).max(axis=1).min() < 12.0  # lips closed
    assert protrusion[28:40].max() > protrusion[:20].max() + 50.0
    assert not faps[-1].round(1).any()


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


def test_targets_close_labials_and_open_vowels() -> None:
    targets = static_targets()
    column = {fap: MOUTH_FAPS.index(fap) for fap in MOUTH_FAPS}
    assert targets.shape == (len(VISEMES), len(MOUTH_FAPS))
    assert not targets[VISEME_INDEX[REST]].any()
    inner = [column[fap] for fap in CLOSURE_FAPS["b"] if fap < 51]
    assert not targets[VISEME_INDEX["b"], inner].any()
    assert targets[VISEME_INDEX["f"], column[5]] == 0.0  # lower lip at the teeth
    jaw = targets[:, column[3]]
    assert jaw[VISEME_INDEX["a"]] == max(jaw) == 450.0
    width = targets[:, column[6]]
    assert width[VISEME_INDEX["u"]] < 3 * width[VISEME_INDEX["i"]] < 0.0
