"""Mouth movements are scaled, closures are kept."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.services.synthesizer.modifiers.expressiveness import Expressiveness
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from tests.lips import LIPS

pytestmark = pytest.mark.unit

DEFAULT = SynthesizerConfig().expressiveness
UPPER, LOWER = np.array([[4, 8, 9, 51, 55, 56], [5, 10, 11, 52, 57, 58]]) - 1
JAW, CORNER, PUSH = 3 - 1, 6 - 1, 17 - 1


def target(viseme: str) -> NDArray[np.float32]:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = LIPS.parameters.target[VISEME_INDEX[viseme]]
    return faps


def expressed(faps: NDArray[np.float32], amount: float) -> NDArray[np.float32]:
    changed = faps.copy()
    Expressiveness(amount).scale(changed)
    return changed


def gaps(faps: NDArray[np.float32]) -> NDArray[np.float32]:
    apart: NDArray[np.float32] = -(faps[UPPER] + faps[LOWER])
    return apart


@pytest.mark.parametrize("amount", [0.5, DEFAULT, 2.0])
def test_closed_lips_stay_closed(amount: float) -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        faps = rng.normal(0.0, 150.0, NUM_FAPS).astype(np.float32)
        closed = gaps(faps) <= 20.0
        changed = expressed(faps, amount)
        np.testing.assert_array_equal(changed[UPPER][closed], faps[UPPER][closed])
        np.testing.assert_array_equal(changed[LOWER][closed], faps[LOWER][closed])
        assert (gaps(changed)[~closed] > 20.0 - 1e-3).all()


@pytest.mark.parametrize("viseme", ["a", "e", "i", "o", "u", "v"])
def test_opens_further_up_to_a_limit(viseme: str) -> None:
    opened = [expressed(target(viseme), amount) for amount in (0.5, 0.8, 1.0, DEFAULT, 2.0)]
    middle = [float(gaps(faps)[0]) for faps in opened]
    assert middle == sorted(middle)
    assert middle[0] < 0.75 * middle[2]
    assert middle[3] > 1.1 * middle[2]
    assert middle[-1] < 900.0
    assert opened[-1][JAW] < 500.0


def test_exaggerates_spreading_and_rounding() -> None:
    assert expressed(target("i"), DEFAULT)[CORNER] > 5.0
    plain, more = target("u"), expressed(target("u"), DEFAULT)
    assert more[CORNER] < 1.3 * plain[CORNER] < 0.0
    assert 1.2 * plain[PUSH] < more[PUSH] <= 400.0
