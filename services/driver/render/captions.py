"""Draws captions of the speech below a picture, and highlights the current syllable or phone."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from PIL import Image, ImageDraw

from kouxing.shared.arrays import UInt8
from kouxing.shared.fonts import font_for

_TEXT_HEIGHT, _TEXT_WIDTH = 1 / 14, 1 / 20  # largest letters, as fractions of the picture
_MIN_TEXT_PX = 12.0
_BAND_HEIGHT, _MARGIN, _SPACE, _JOINT = 1.9, 0.8, 0.5, 0.15  # letter heights
PAUSE_S = 0.6  # ends a line
_EARLY_S = 0.4  # a line appears this long before its first syllable
_BAND, _TEXT, _OUTLINE = "#14171c", "#d5d9df", "#000000"
_CURRENT_BOX, _CURRENT_TEXT = "#ffd23f", "#14171c"


@dataclass(frozen=True, slots=True)
class Caption:
    """A syllable or phone to show."""

    start_s: float
    end_s: float
    text: str
    is_joined: bool = False  # no space separates it from the previous caption


def band_height_px(size_px: tuple[int, int]) -> int:
    """Return the height of the band with captions in a video of this size; it is even."""
    return 2 * round(_text_px(size_px) * _BAND_HEIGHT / 2)


def _text_px(size_px: tuple[int, int]) -> float:
    width_px, height_px = size_px
    return max(min(height_px * _TEXT_HEIGHT, width_px * _TEXT_WIDTH), _MIN_TEXT_PX)


class CaptionDrawer:
    """Draws captions in a band below the picture, where they hide nothing.

    ``captions`` are sorted by time. ``size_px`` is the size of the picture with the band.
    """

    def __init__(self, captions: Sequence[Caption], size_px: tuple[int, int]) -> None:
        self._text_px = _text_px(size_px)
        self._font = font_for("".join(caption.text for caption in captions), self._text_px)
        self._width_px = size_px[0]
        self.height_px = band_height_px(size_px)
        self._lines = self._break_lines(captions)

    def add_below(self, picture: UInt8, time_s: float) -> UInt8:
        """Return a picture (H, W, 3 or 4) with the captions of a time below it."""
        is_transparent = picture.shape[2] == 4
        mode = "RGBA" if is_transparent else "RGB"
        band = Image.new(
            mode, (self._width_px, self.height_px), (0, 0, 0, 0) if is_transparent else _BAND
        )
        self._draw(ImageDraw.Draw(band), self._line_at(time_s), time_s)
        return np.concatenate([picture, np.asarray(band)])

    def _draw(self, pen: ImageDraw.ImageDraw, line: Sequence[Caption], time_s: float) -> None:
        middle = self.height_px / 2
        x = (self._width_px - self._length_px(line)) / 2
        for number, caption in enumerate(line):
            x += self._space_px(caption) if number else 0.0
            end = x + self._font.getlength(caption.text)
            is_current = caption.start_s <= time_s < caption.end_s
            if is_current:
                pad, half = 0.12 * self._text_px, 0.75 * self._text_px
                box = (x - pad, middle - half, end + pad, middle + half)
                pen.rounded_rectangle(box, 0.2 * self._text_px, _CURRENT_BOX)
            pen.text(
                (x, middle + 0.35 * self._text_px),
                caption.text,
                _CURRENT_TEXT if is_current else _TEXT,
                self._font,
                "ls",
                stroke_width=0 if is_current else round(0.06 * self._text_px),
                stroke_fill=_OUTLINE,
            )
            x = end

    def _line_at(self, time_s: float) -> Sequence[Caption]:
        """Return the line at a time. The first is shown from the start, the last to the end."""
        shown: Sequence[Caption] = self._lines[0] if self._lines else ()
        for before, line in pairwise(self._lines):
            if time_s >= max(before[-1].end_s, line[0].start_s - _EARLY_S):
                shown = line
        return shown

    def _break_lines(self, captions: Sequence[Caption]) -> list[list[Caption]]:
        """Start a new line after a pause, and when a line is full."""
        lines: list[list[Caption]] = []
        max_px = self._width_px - 2 * _MARGIN * self._text_px
        for caption in captions:
            is_pause = lines and caption.start_s - lines[-1][-1].end_s > PAUSE_S
            if not lines or is_pause or self._length_px([*lines[-1], caption]) > max_px:
                lines.append([])
            lines[-1].append(caption)
        return lines

    def _length_px(self, line: Sequence[Caption]) -> float:
        spaces = sum(self._space_px(caption) for caption in line[1:])
        return spaces + sum(self._font.getlength(caption.text) for caption in line)

    def _space_px(self, caption: Caption) -> float:
        return self._text_px * (_JOINT if caption.is_joined else _SPACE)
