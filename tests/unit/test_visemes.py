"""Phones to visemes: table 1 of Li et al. 2011, and visemes of sounds that Mandarin lacks."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    TRAINED_VISEMES,
    VISEMES,
    check_visemes,
    visemes_of,
)
from kouxing.services.synthesizer.lips.ferguson.phone_table import load_table
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.inventory import BUILT_IN, load_inventory
from tests.lips import INVENTORY, lip_gaps, phone, viseme_faps


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


NUMBER = {fap.name: fap.number - 1 for fap in FAPS}


def width(faps: NDArray[np.float32]) -> float:
    return float(faps[..., NUMBER["stretch_l_cornerlip"]])


def opening(viseme: str) -> float:
    return float(lip_gaps(viseme_faps(viseme)).mean())


def test_rounded_visemes_are_narrow() -> None:
    for viseme in ("w", "oe", "oeh", "aw", "r"):
        assert width(viseme_faps(viseme)) < -50, viseme
    assert width(viseme_faps("w")) < width(viseme_faps("u"))
    assert width(viseme_faps("uu")) > -40  # the Japanese u is not rounded
    assert width(viseme_faps("ae")) > 0


def test_openings_follow_the_vowels() -> None:
    assert 0 < opening("w") < opening("u") < opening("oe") < opening("oeh") < opening("aw")
    assert opening("aw") < opening("ae") < opening("a")
    assert 0 < opening("bh") < opening("w")  # not closed
    assert opening("uu") < opening("i")


def test_the_tongue_is_between_the_teeth_in_th() -> None:
    tip = NUMBER["thrust_tongue_tip"]
    assert viseme_faps("th")[tip] > 100 > viseme_faps("d")[tip]


def test_a_derived_viseme_has_the_dominance_of_its_base() -> None:
    parameters = initial_parameters()
    w, u = VISEMES.index("w"), VISEMES.index("u")
    assert w >= len(TRAINED_VISEMES) > u
    np.testing.assert_array_equal(parameters.alpha[w], parameters.alpha[u])
    assert not parameters.closes[len(TRAINED_VISEMES) :].any()


@pytest.mark.parametrize("language", sorted({*BUILT_IN} - {"mandarin"}))
@pytest.mark.parametrize("lips", ["dynamic-visemes", "ferguson"])
def test_lips_speak_every_language(language: str, lips: str) -> None:
    inventory = load_inventory(language)
    stream = load_lip_model(language, lips).stream(0.0, frame_rate_hz=50.0, delay_s=0.16)
    symbols = ["a", "m", "a", "sil"]
    for index, symbol in enumerate(symbols):
        stream.add_event(phone(index, symbol, 0.2 + 0.2 * index, 0.2))
    gaps = [lip_gaps(_face(stream.frame_at(0.02 * number).faps)).mean() for number in range(60)]
    assert gaps[0] == pytest.approx(0, abs=20)
    assert min(gaps[19:31]) < 40
    assert max(gaps[10:19]) > 200
    assert load_table(inventory).opening["a"] > 3


def _face(mouth: NDArray[np.float64]) -> NDArray[np.float32]:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = mouth
    return faps
