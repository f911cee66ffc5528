"""Draws several faces side by side in one picture, each with a caption."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kouxing.services.driver.render.renderer import Renderer
from kouxing.shared.arrays import Floats, UInt8

_CAPTION_FRACTION = 1 / 20  # height of the letters, as a fraction of the picture


class SideBySideRenderer:
    """Draws one face per caption, from left to right."""

    def __init__(self, renderer: Renderer, captions: Sequence[str]) -> None:
        width_px, height_px = renderer.size
        self.size = (width_px * len(captions), height_px)
        self.transparent = renderer.transparent
        self._renderer = renderer
        self._captions = _draw_captions(captions, width_px, height_px)

    def draw(self, faps: Floats) -> UInt8:
        """Draw faces (num_faces, 68); the picture has the format of ``Renderer.draw``."""
        faces = np.concatenate([self._renderer.draw(face) for face in faps], axis=1)
        picture = Image.fromarray(faces)
        picture.paste("white", mask=self._captions)
        return np.asarray(picture)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._renderer.close()


def _draw_captions(captions: Sequence[str], width_px: int, height_px: int) -> Image.Image:
    """Return the coverage of each pixel by the captions, centered below the faces."""
    mask = Image.new("L", (width_px * len(captions), height_px))
    pen = ImageDraw.Draw(mask)
    font = ImageFont.load_default(max(height_px * _CAPTION_FRACTION, 8))
    for number, caption in enumerate(captions):
        middle = ((number + 0.5) * width_px, height_px * (1 - _CAPTION_FRACTION))
        pen.text(middle, caption, fill=255, font=font, anchor="ms")
    return mask
