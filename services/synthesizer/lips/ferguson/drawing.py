"""Draws the mouth in two dimensions, as SVG text or pictures.

A drawing is a list of outlines and labels, in pixels, with y downward. ``to_svg`` and
``rasterize`` convert it to SVG text and to a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from html import escape
from itertools import pairwise
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw

from kouxing.services.synthesizer.lips.ferguson.contour import compute_rounded_contour
from kouxing.shared.arrays import Doubles, Mask, UInt8
from kouxing.shared.fonts import text_runs

_POINTS_OF_LINE = 61
_UPPER_LIP, _LOWER_LIP, _SHINE = "#b5505a", "#c9626b", "#da8288"
_INSIDE, _TEETH, _TONGUE = "#3a1418", "#f6f1e7", "#a84a52"
_INK, _FAINT_INK, PAPER = "#222222", "#777777", "#ffffff"
# lower edge of the upper teeth and position of the tongue, mouth widths from the inner corners
_TEETH_EDGE, _TEETH_HALF_WIDTH, _TEETH_ROUNDNESS = -0.085, 0.30, 0.05
_TONGUE_BELOW_TEETH, _TONGUE_HALF_WIDTH = 0.045, 0.27
_LINE_PX_PER_WIDTH = 0.006
_PX_PER_CHARACTER = 0.6  # width of a letter, relative to the size of the text
# bounding box of a mouth at any opening, mouth widths
WIDTH, HIGHEST, LOWEST = 1.16, 0.24, -0.44
_ANCHORS = {"start": 0.0, "middle": 0.5, "end": 1.0}  # fraction of a label left of its x
_SUPERSAMPLING = 3


@dataclass(frozen=True, slots=True)
class Outline:
    """A filled polygon, or an open line."""

    points: Doubles  # (num_points, 2), pixels
    color: str  # "#rrggbb"
    line_px: float | None = None  # line width; None for a filled polygon


@dataclass(frozen=True, slots=True)
class Label:
    """A line of text."""

    text: str
    x: float  # pixels
    y: float  # baseline
    size_px: float
    color: str = _INK
    anchor: Literal["start", "middle", "end"] = "middle"  # the part of the text at x


@dataclass(frozen=True, slots=True)
class Drawing:
    """Outlines, from back to front, and labels."""

    width_px: int
    height_px: int
    outlines: list[Outline] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)


def draw_mouth(
    opening: float, center_px: tuple[float, float], width_px: float, width: float = 1.0
) -> list[Outline]:
    """Draw a mouth with opening R, 0 to 5.

    ``width_px`` is the distance of the corners at rest, and ``width`` their distance relative to
    it: less than 1 if the lips are rounded.
    """
    lines = compute_rounded_contour([opening], [width], _POINTS_OF_LINE)[0]
    outer_upper, inner_upper, inner_lower, outer_lower = lines
    x, top, bottom = inner_upper[:, 0], inner_upper[:, 1], inner_lower[:, 1]
    # the upper teeth do not move; the lips uncover them
    edge = _TEETH_EDGE + _TEETH_ROUNDNESS * ((x - 0.5) / _TEETH_HALF_WIDTH) ** 2
    teeth = np.clip(edge, bottom, top)
    # the tongue is behind the lower lip
    bow = 1.0 - ((x - 0.5) / _TONGUE_HALF_WIDTH) ** 2
    highest = max(0.0, _TEETH_EDGE - _TONGUE_BELOW_TEETH - float(bottom.min()))
    tongue = np.clip(bottom + 0.8 * highest * bow, bottom, top)
    near_teeth = np.abs(x - 0.5) < _TEETH_HALF_WIDTH + 0.03
    near_tongue = np.abs(x - 0.5) < _TONGUE_HALF_WIDTH
    # highlight in the middle of the lower lip
    lower_edge = np.interp(x, outer_lower[:, 0], outer_lower[:, 1])
    level = 0.5 + 0.16 * (1.0 - ((x - 0.5) / 0.25) ** 2)
    on_lip = np.abs(x - 0.5) < 0.25
    shine_low, shine_high = (
        bottom + (lower_edge - bottom) * height for height in (level, 1.0 - level)
    )

    def between(above: Doubles, below: Doubles, where: Mask) -> Doubles:
        upper, lower = (np.stack([x, line], axis=1)[where] for line in (above, below))
        return np.concatenate([upper, lower[::-1]])

    everywhere = np.ones(len(x), dtype=bool)
    line_px = _LINE_PX_PER_WIDTH * width_px
    both_lips = np.concatenate([outer_upper, outer_lower[::-1]])
    outlines = [
        Outline(both_lips, _LOWER_LIP),
        Outline(np.concatenate([outer_upper, inner_upper[::-1]]), _UPPER_LIP),
        Outline(between(shine_high, shine_low, on_lip), _SHINE),
        Outline(between(top, bottom, everywhere), _INSIDE),
        Outline(between(tongue, bottom, near_tongue), _TONGUE),
        Outline(between(top, teeth, near_teeth), _TEETH),
        Outline(inner_upper, _INSIDE, line_px),
        Outline(inner_lower, _INSIDE, line_px),
    ]

    def placed(points: Doubles) -> Doubles:
        return np.array(center_px) + (points - [0.5, 0.0]) * [width_px, -width_px]

    return [Outline(placed(line.points), line.color, line.line_px) for line in outlines]


@dataclass(frozen=True, slots=True)
class LabeledMouth:
    """A mouth to draw, with its time and speech."""

    time_s: float
    opening: float  # R
    phone: str
    syllable: str = ""  # a syllable that starts here
    width: float = 1.0  # relative to the mouth at rest


def draw_strip(mouths: Sequence[LabeledMouth], max_columns: int, mouth_px: float) -> Drawing:
    """Draw mouths in order of time, in rows, with syllables above, phones and times below.

    ``mouth_px`` is the width of a mouth.
    """
    columns = max(1, min(max_columns, len(mouths)))
    rows = -(-len(mouths) // columns)
    cell_px = WIDTH * mouth_px
    text_px = 0.115 * mouth_px
    mouth_height_px = (HIGHEST - LOWEST) * mouth_px
    row_px = mouth_height_px + 5.0 * text_px
    drawing = Drawing(round(columns * cell_px), round(rows * row_px + text_px))
    spoken = [number for number, labeled in enumerate(mouths) if labeled.syllable]
    next_of = dict(pairwise([*spoken, len(mouths)]))
    for number, labeled in enumerate(mouths):
        left, top = number % columns * cell_px, number // columns * row_px
        middle = left + 0.5 * cell_px
        mouth_top = top + 1.9 * text_px
        if labeled.syllable:
            label = Label(labeled.syllable, middle, top + 1.4 * text_px, 1.2 * text_px)
            num_cells = min(next_of[number] - number, columns - number % columns)
            drawing.labels.append(_fit(label, left, cell_px, num_cells * cell_px))
        center = (middle, mouth_top + HIGHEST * mouth_px)
        drawing.outlines.extend(draw_mouth(labeled.opening, center, mouth_px, labeled.width))
        below = mouth_top + mouth_height_px
        drawing.labels.append(Label(labeled.phone, middle, below + 1.1 * text_px, text_px))
        time = f"{labeled.time_s:.2f} s"
        drawing.labels.append(
            Label(time, middle, below + 2.3 * text_px, 0.85 * text_px, _FAINT_INK)
        )
    return drawing


def _fit(label: Label, left: float, cell_px: float, room_px: float) -> Label:
    """Start a label wider than its cell at ``left``, and shrink it to ``room_px``."""
    width_px = _PX_PER_CHARACTER * label.size_px * len(label.text)
    if width_px <= cell_px:
        return label
    size_px = label.size_px * min(1.0, room_px / width_px)
    return replace(label, x=left, size_px=size_px, anchor="start")


def draw_image(labeled: LabeledMouth, width_px: int, height_px: int) -> Drawing:
    """Draw one mouth that fills a picture, with its time and speech."""
    drawing = Drawing(width_px, height_px)
    text_px = 0.06 * height_px
    mouth_px = min(width_px / WIDTH, (height_px - 3.0 * text_px) / (HIGHEST - LOWEST))
    center = (0.5 * width_px, 0.5 * text_px + HIGHEST * mouth_px)
    drawing.outlines.extend(draw_mouth(labeled.opening, center, mouth_px, labeled.width))
    below = height_px - text_px
    drawing.labels.append(
        Label(f"{labeled.time_s:.2f} s", text_px, below, text_px, _FAINT_INK, "start")
    )
    drawing.labels.append(Label(labeled.syllable, 0.5 * width_px, below, 1.4 * text_px))
    drawing.labels.append(
        Label(labeled.phone, width_px - text_px, below, text_px, _FAINT_INK, "end")
    )
    return drawing


def to_svg(drawing: Drawing) -> str:
    """Return a drawing as the text of an SVG file."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{drawing.width_px}"'
        f' height="{drawing.height_px}" viewBox="0 0 {drawing.width_px} {drawing.height_px}">',
        f'<rect width="100%" height="100%" fill="{PAPER}"/>',
    ]
    for outline in drawing.outlines:
        if len(outline.points) < 2:
            continue
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in outline.points)
        if outline.line_px is None:
            lines.append(f'<path d="{path}Z" fill="{outline.color}"/>')
        else:
            lines.append(
                f'<path d="{path}" fill="none" stroke="{outline.color}"'
                f' stroke-width="{outline.line_px:.1f}" stroke-linecap="round"/>'
            )
    lines += [
        f'<text x="{label.x:.1f}" y="{label.y:.1f}" font-size="{label.size_px:.1f}"'
        f' text-anchor="{label.anchor}" fill="{label.color}" font-family="sans-serif">'
        f"{escape(label.text)}</text>"
        for label in drawing.labels
    ]
    return "\n".join([*lines, "</svg>", ""])


def rasterize(drawing: Drawing) -> UInt8:
    """Return a drawing as a picture (height_px, width_px, 3), sRGB."""
    fine = Image.new(
        "RGB", (drawing.width_px * _SUPERSAMPLING, drawing.height_px * _SUPERSAMPLING), PAPER
    )
    pen = ImageDraw.Draw(fine)
    for outline in drawing.outlines:
        points = [tuple(point) for point in (outline.points * _SUPERSAMPLING).tolist()]
        if len(points) < 2:
            continue
        if outline.line_px is None:
            pen.polygon(points, fill=outline.color)
        else:
            width = max(1, round(outline.line_px * _SUPERSAMPLING))
            pen.line(points, fill=outline.color, width=width, joint="curve")
    for label in drawing.labels:
        runs = text_runs(label.text, max(label.size_px * _SUPERSAMPLING, 1.0))
        length = sum(font.getlength(text) for text, font in runs)
        x = label.x * _SUPERSAMPLING - length * _ANCHORS[label.anchor]
        for text, font in runs:
            pen.text((x, label.y * _SUPERSAMPLING), text, label.color, font, "ls")
            x += font.getlength(text)
    picture = fine.resize((drawing.width_px, drawing.height_px), Image.Resampling.BOX)
    return np.asarray(picture)
