"""Several faces beside each other in one picture, each with a caption."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kouxing.services.driver.render.renderer import Float32, Renderer, UInt8

_CAPTION_SHARE = 1 / 20  # height of its letters, as a share of the picture's


class SideBySide:
    """Draws as many faces as there are captions, from left to right.

    Parameters
    ----------
    renderer
        What draws one of them.
    captions
        What stands under each.
    """

    def __init__(self, renderer: Renderer, captions: Sequence[str]) -> None:
        width_px, height_px = renderer.size
        self.size = (width_px * len(captions), height_px)
        self.transparent = renderer.transparent
        self._renderer = renderer
        self._captions = _draw_captions(captions, width_px, height_px)

    def draw(self, faps: Float32) -> UInt8:
        """Draw one picture of faces (num_faces, 68); shape as ``Renderer.draw``."""
        faces = np.concatenate([self._renderer.draw(each) for each in faps], axis=1)
        picture = Image.fromarray(faces)
        picture.paste("white", mask=self._captions)
        return np.asarray(picture)

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()


def _draw_captions(captions: Sequence[str], width_px: int, height_px: int) -> Image.Image:
    """Write each caption in the middle below its face; return how much of it covers a pixel."""
    mask = Image.new("L", (width_px * len(captions), height_px))
    pen = ImageDraw.Draw(mask)
    font = ImageFont.load_default(max(height_px * _CAPTION_SHARE, 8))
    for number, caption in enumerate(captions):
        middle = ((number + 0.5) * width_px, height_px * (1 - _CAPTION_SHARE))
        pen.text(middle, caption, fill=255, font=font, anchor="ms")
    return mask
