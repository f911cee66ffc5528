"""The shapes of the Ferguson contour: opening, outline, and whether any of them is "sick".

Source: Zhang et al. 2021, section 6.2, second experiment: unnatural bumps and dents. Here a shape
is faulty if lips or edges cross, an edge bends more sharply than lips do, or has more dents than
Cupid's bow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Table

from kouxing.corpora.figures import new_figure
from kouxing.services.synthesizer.lips.ferguson.contour import LINES, lip_lines, lip_points
from kouxing.services.synthesizer.lips.ferguson.motion import MAX_OPENING

Array = NDArray[np.float64]

MAX_CURVATURE = 5.0  # a mouth width: a radius of 9 mm
MAX_INFLECTIONS = 2  # of one edge: a dent between two bumps
_STRAIGHT = 0.2  # curvature below which an edge is straight
_ROUNDING = 1e-9
_NUM_POINTS = 201


@dataclass(frozen=True, slots=True, kw_only=True)
class ShapeFigures:
    """Figures of some shapes, each (num_shapes,); lengths in mouth widths."""

    openings: Array  # R
    gap: Array  # between the lips, in the middle
    narrowest: Array  # gap anywhere: below 0, the lips cross
    thinnest: Array  # either lip, between the inner corners
    sharpest: Array  # curvature of any edge, 1 / mouth width
    inflections: NDArray[np.int64]  # most of any edge

    @property
    def faults(self) -> NDArray[np.int64]:
        """Which of the shapes are faulty, (num_faults,)."""
        is_faulty = (
            (self.narrowest < -_ROUNDING)
            | (self.thinnest <= 0.0)
            | (self.sharpest > MAX_CURVATURE)
            | (self.inflections > MAX_INFLECTIONS)
        )
        return np.flatnonzero(is_faulty)


def check_shapes(openings: ArrayLike) -> ShapeFigures:
    """Measure the shapes of the contour at openings R (num_shapes,)."""
    opening = np.asarray(openings, dtype=np.float64)
    lines = lip_lines()
    inner = np.linspace(*lines["inner upper"].ends, _NUM_POINTS)
    outer_upper, inner_upper, inner_lower, outer_lower = (
        lines[name].heights(inner, opening) for name in LINES
    )
    gap = inner_upper - inner_lower
    thickness = np.minimum(outer_upper - inner_upper, inner_lower - outer_lower)
    curvature = np.stack([_curvature(name, opening) for name in LINES])
    return ShapeFigures(
        openings=opening,
        gap=gap[:, _NUM_POINTS // 2],
        narrowest=gap.min(axis=1),
        thinnest=thickness.min(axis=1),
        sharpest=np.abs(curvature).max(axis=(0, 2)),
        inflections=np.max([[_inflections(row) for row in edge] for edge in curvature], axis=0),
    )


def _curvature(name: str, openings: Array) -> Array:
    """Signed curvature along a line, (num_shapes, num_points), 1 / mouth width."""
    line = lip_lines()[name]
    x = np.linspace(*line.ends, _NUM_POINTS)
    slope, bend = (
        line.closed(x, order) + openings[:, None] * line.travel(x, order) for order in (1, 2)
    )
    curvature: Array = bend / (1.0 + slope**2) ** 1.5
    return curvature


def _inflections(curvature: Array) -> int:
    """Count changes between bending up and bending down."""
    side = np.sign(curvature[np.abs(curvature) > _STRAIGHT])
    return int(np.sum(side[1:] != side[:-1]))


def print_shapes(figures: ShapeFigures, console: Console) -> None:
    """Print a row for each whole opening, and the worst of all shapes."""
    table = Table("R", "gap", "narrowest gap", "thinnest lip", "sharpest bend", "inflections")
    for opening in range(int(MAX_OPENING) + 1):
        row = int(np.argmin(np.abs(figures.openings - opening)))
        table.add_row(f"{opening}", *_cells(figures, row))
    console.print(table)
    console.print(
        f"{len(figures.openings)} shapes: {len(figures.faults)} faulty; lips cross by"
        f" {max(0.0, -float(figures.narrowest.min())):.3f}, thinnest lip"
        f" {figures.thinnest.min():.3f}, sharpest bend {figures.sharpest.max():.2f} (at most"
        f" {MAX_CURVATURE:g}), at most {figures.inflections.max()} inflections"
    )


def _cells(figures: ShapeFigures, row: int) -> Sequence[str]:
    return (
        f"{figures.gap[row]:.3f}",
        f"{max(0.0, figures.narrowest[row]):.3f}",
        f"{figures.thinnest[row]:.3f}",
        f"{figures.sharpest[row]:.2f}",
        f"{figures.inflections[row]}",
    )


def shapes_figure() -> Any:
    """Draw the contours from closed to widest, the travels, and the curvatures."""
    figure = new_figure(14.0, 4.2)
    outlines, travels, bends = figure.subplots(1, 3)
    points = lip_points()
    for opening in range(int(MAX_OPENING) + 1):
        shade = str(0.8 - 0.16 * opening)
        for line in lip_lines().values():
            x = np.linspace(*line.ends, _NUM_POINTS)
            outlines.plot(x, line.heights(x, [opening])[0], color=shade)
    for number, (name, line) in enumerate(lip_lines().items()):
        x = np.linspace(*line.ends, _NUM_POINTS)
        knots = np.array([points[point].x for point in LINES[name]])
        outlines.plot(knots, line.heights(knots, [MAX_OPENING])[0], "o", color=f"C{number}")
        travels.plot(x, MAX_OPENING * line.travel(x), color=f"C{number}", label=name)
        travels.plot(knots, MAX_OPENING * line.travel(knots), "o", color=f"C{number}")
        bends.plot(x, _curvature(name, np.array([MAX_OPENING]))[0], color=f"C{number}")
    outlines.set_aspect("equal")
    outlines.set_title("contours at R = 0 to 5 (dots: feature points)", fontsize=10)
    travels.set_title("travel up at R = 5: cubic pieces, C2", fontsize=10)
    travels.legend(fontsize=8)
    bends.set_title("curvature at R = 5, 1 / mouth width", fontsize=10)
    for axis in (outlines, travels, bends):
        axis.set_xlabel("x, mouth widths")
    return figure
