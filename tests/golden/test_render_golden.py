"""Software GL draws the stored pictures, up to a tolerance.

After an intended change of looks, run with ``WRITE_GOLDEN=1`` and look at the pictures.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kouxing.services.driver.render.renderer import Renderer
from tests import heads
from tests.heads import neutral_faps

SHAPES = {
    "rest": neutral_faps(),
    "a": neutral_faps(
        open_jaw=450, lower_t_midlip=-280, raise_b_midlip=-600, lower_t_lip_lm=-220,
        lower_t_lip_rm=-220, raise_b_lip_lm=-520, raise_b_lip_rm=-520, lower_t_midlip_o=-260,
        raise_b_midlip_o=-510, raise_b_lip_lm_o=-520, raise_b_lip_rm_o=-520,
    ),
    "turned": neutral_faps(head_yaw=40_000, yaw_l_eyeball=-20_000, yaw_r_eyeball=-20_000),
}  # fmt: skip


PICTURES = [
    *(("woman", shape) for shape in SHAPES),
    ("man", "a"),
    ("elder", "rest"),
    ("child", "a"),
]


@pytest.mark.parametrize(("name", "shape"), PICTURES)
def test_draws_the_stored_picture(name: str, shape: str) -> None:
    renderer = Renderer(heads.load(name, "coarse"), 192, 144, samples=0)
    image = renderer.draw(SHAPES[shape])
    renderer.close()
    stored = Path(__file__).with_name(f"render_{name}_{shape}.png")
    if os.environ.get("WRITE_GOLDEN"):
        Image.fromarray(image).save(stored)
    golden = np.asarray(Image.open(stored).convert("RGB"), dtype=float)
    difference = np.abs(image.astype(float) - golden)
    assert difference.mean() < 1.5
    assert (difference.max(axis=2) > 24).mean() < 0.02
