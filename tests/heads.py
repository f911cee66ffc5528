"""Built-in heads, read once for all tests."""

import functools

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.head.head import ASSETS, Detail, Head
from kouxing.shared.face.faps import FAP_NUMBER, FAPS, NUM_FAPS, Fap

NAMES = sorted(path.stem for path in ASSETS.glob("*.npz"))
AXES = {
    "down": (1, -1.0),
    "up": (1, 1.0),
    "left": (0, 1.0),
    "right": (0, -1.0),
    "forward": (2, 1.0),
}


def neutral_faps(**values: float) -> NDArray[np.float32]:
    """Return FAPs (68,) that are zero except for the named ones."""
    faps = np.zeros(NUM_FAPS, np.float32)
    for name, value in values.items():
        faps[FAP_NUMBER[name] - 1] = value
    return faps


OPEN_MOUTH = neutral_faps(
    open_jaw=450, lower_t_midlip=-280, raise_b_midlip=-600, lower_t_lip_lm=-220,
    lower_t_lip_rm=-220, raise_b_lip_lm=-520, raise_b_lip_rm=-520, raise_b_midlip_o=-510,
    raise_b_lip_lm_o=-520, raise_b_lip_rm_o=-520,
)  # fmt: skip
DISPLACING_FAPS = [fap for fap in FAPS if fap.direction in AXES and fap.fapu != "AU"]


@functools.cache
def load(name: str, detail: Detail = "fine") -> Head:
    return Head.load(name, detail)


def travel_m(head: Head, fap: Fap, value: float) -> tuple[int, float]:
    """Return the direction and distance of a FAP's displacement."""
    axis, sign = AXES[fap.direction]
    return axis, sign * value * head.fapu[fap.fapu] / 1024


def single_fap(number: int, value: float) -> NDArray[np.float32]:
    """Return FAPs (68,) with one value."""
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[number - 1] = value
    return faps
