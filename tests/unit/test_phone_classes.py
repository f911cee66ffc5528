"""Every class of phones changes every output, and shapes determine the lips they come from."""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.offline_visemes import synthesize
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.phones.inventory import load_inventory
from tests import heads
from tests.lips import phone
from tests.receivers import SENT, received

Values = NDArray[np.float32]
PHONE_S, FRAME_RATE_HZ = 0.2, 50
VISIBLE = 0.1  # share of a whole shape
LIPS = ("2.2", "2.3", "2.4", "2.5", "2.6", "2.7", "2.8", "2.9", *(f"8.{k}" for k in range(1, 9)))

# The columns of the table: the values, 0 to 1, that a receiver gets for FAPs (68,).
OUTPUTS: dict[str, Callable[[Values], Values]] = {
    **{str(name): shapes.weights for name, shapes in SHAPE_SETS.items()},
    **{url: partial(received, url) for url in SENT},
}


def phone_classes() -> dict[str, str]:
    """Return the rows of the table: the first phone of each viseme, and its kind."""
    inventory = load_inventory()
    classes: dict[str, tuple[str, str]] = {}
    for symbol, kind in zip(inventory.phones, inventory.kinds, strict=True):
        if kind != "silence":
            classes.setdefault(inventory.visemes[symbol][0][0], (symbol, kind))
    return dict(classes.values())


@cache
def frames_of(*symbols: str) -> Values:
    """Return the FAPs of phones of one length, from one to the other."""
    lips = load_lip_model(name="dynamic-visemes")
    assert isinstance(lips, DynamicVisemes)
    phones = [
        phone(index, symbol, index * PHONE_S, PHONE_S) for index, symbol in enumerate(symbols)
    ]
    return synthesize(lips, phones, round(len(phones) * PHONE_S * FRAME_RATE_HZ), FRAME_RATE_HZ)


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize(("symbol", "kind"), phone_classes().items())
def test_every_class_of_phones_moves_every_output(symbol: str, kind: str, output: str) -> None:
    neighbor = "a" if kind == "initial" else "sil"
    spoken, without = (frames_of(neighbor, middle, neighbor) for middle in (symbol, neighbor))
    middle = slice(round(PHONE_S * FRAME_RATE_HZ), round(2 * PHONE_S * FRAME_RATE_HZ), 3)
    values, others = (
        np.array([OUTPUTS[output](faps) for faps in frames[middle]]) for frames in (spoken, without)
    )
    assert np.abs(values - others).max() > VISIBLE


@pytest.mark.parametrize(("name", "max_mm"), [("arkit", 0.5), ("oculus", 2.0), ("vrm", 1.9)])
def test_shapes_lead_back_to_the_lips(name: str, max_mm: float) -> None:
    head, shapes = heads.load("woman", "coarse"), SHAPE_SETS[name]
    points = [head.feature_points[point] for point in LIPS]
    errors_mm = []
    for symbol in phone_classes():
        for faps in frames_of("a", symbol, "a")[::3]:
            back = shapes.faps(shapes.weights(faps))
            error_m = (head.deform(back) - head.deform(faps))[points]
            errors_mm.append(1000 * np.linalg.norm(error_m, axis=1))
    assert np.mean(errors_mm) < max_mm  # as docs/shapes.md states
