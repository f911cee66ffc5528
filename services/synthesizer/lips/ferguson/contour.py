"""Computes the lip contour and the FAPs at an opening R.

Source: Zhang et al. 2021, section 3. Four lines of five MPEG-4 feature points with shared corners
have 16 points. The upward travel of each point was measured once. A Ferguson curve, a piecewise
cubic with two continuous derivatives, passes through a line's points ``(x_j, dy_j)`` and gives the
travel at any ``x``, so a contour may have any number of points:

    l(x) = y(x) + R dy(x)                                                          (eq. 4)

======  ============================================  ============  ======================
symbol  meaning                                       unit          shape
======  ============================================  ============  ======================
x       along the mouth, 0 and 1 at the corners       mouth widths  (num_points,)
y       height of the closed lip                      mouth widths  (num_points,)
dy      travel up for R = 1                           mouth widths  (num_points,)
R       opening, 0 (closed) to 5 (widest)             1             (num_frames,)
======  ============================================  ============  ======================

``lip_points.tsv`` contains the points and describes how they were measured.

Deviations: The closed lip is also a Ferguson curve, and its upper edge passes through the two peaks
of Cupid's bow. The curves have free ends (natural splines). As in the paper, lips move only
vertically: the corners do not move, so /u/ is a small opening.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from kouxing.services.synthesizer.lips.ferguson.phone_table import MAX_OPENING
from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, MOUTH_FAPS
from kouxing.shared.files.tsv_tables import read_table

# feature points from the subject's right to the left
LINES = {
    "outer upper": ("8.4", "8.6", "8.1", "8.5", "8.3"),
    "inner upper": ("2.5", "2.7", "2.2", "2.6", "2.4"),
    "inner lower": ("2.5", "2.9", "2.3", "2.8", "2.4"),
    "outer lower": ("8.4", "8.8", "8.2", "8.7", "8.3"),
}
_STATIC_POINTS = {"outer upper": ("8.9", "8.10")}  # points of the closed line that do not travel
_MOUTH_WIDTHS_PER_MNS = 0.39  # for the head "woman"
_WIDTH_RANGE = (0.6, 1.2)  # from rounded to spread lips
_FAP_UNIT = _MOUTH_WIDTHS_PER_MNS / FAP_UNITS_PER_FAPU


@dataclass(frozen=True, slots=True)
class LipPoint:
    """A feature point of the closed mouth, and its travel."""

    x: float  # mouth widths
    y: float
    fap: int | None  # moves the point vertically
    travel: float  # FAP units at R = 5

    @property
    def rise(self) -> float:
        """Upward travel for R = 1, mouth widths; 0 without a FAP."""
        if self.fap is None:
            return 0.0
        sign = 1.0 if FAPS[self.fap - 1].direction == "up" else -1.0
        return sign * self.travel * _FAP_UNIT / MAX_OPENING


@dataclass(frozen=True, slots=True)
class LipLine:
    """One line of the contour."""

    closed: CubicSpline  # x -> y
    travel: CubicSpline  # x -> dy

    def heights(self, x: ArrayLike, openings: ArrayLike) -> Doubles:
        """Return l (num_frames, num_points) at x (num_points,) for R (num_frames,)."""
        opening = np.asarray(openings, dtype=np.float64)[:, None]
        heights: Doubles = self.closed(x) + opening * self.travel(x)  # Zhang 2021, eq. 4
        return heights


@lru_cache
def load_lip_points() -> dict[str, LipPoint]:
    """Return the points of ``lip_points.tsv`` by name."""
    return {
        row["point"]: LipPoint(
            float(row["x"]),
            float(row["y"]),
            int(row["fap"]) if row["fap"] else None,
            float(row["travel"] or 0.0),
        )
        for row in read_table(__package__, "lip_points.tsv")
    }


@lru_cache
def build_lip_lines() -> dict[str, LipLine]:
    """Return the four lines by name."""
    return {name: _line(name) for name in LINES}


def _line(name: str) -> LipLine:
    points = load_lip_points()
    moving = [points[point] for point in LINES[name]]
    static = [points[point] for point in _STATIC_POINTS.get(name, ())]
    closed = sorted([*moving, *static], key=lambda point: point.x)
    x, y = zip(*((point.x, point.y) for point in closed), strict=True)
    moving_x, rise = zip(*((point.x, point.rise) for point in moving), strict=True)
    return LipLine(
        CubicSpline(x, y, bc_type="natural"), CubicSpline(moving_x, rise, bc_type="natural")
    )


def contour(openings: ArrayLike, num_points: int) -> Doubles:
    """Return the lip contour for openings R (num_frames,), 0 to 5.

    The result has shape (num_frames, 4, num_points, 2): lines as in ``LINES``, and x, y in mouth
    widths of points that are evenly spaced along x.
    """
    points = np.empty((len(np.asarray(openings)), len(LINES), num_points, 2))
    for row, line in enumerate(build_lip_lines().values()):
        x = np.linspace(line.travel.x[0], line.travel.x[-1], num_points)
        points[:, row, :, 0] = x
        points[:, row, :, 1] = line.heights(x, openings)
    return points


def compute_rounded_contour(openings: ArrayLike, widths: ArrayLike, num_points: int) -> Doubles:
    """Return the lip contour for openings R and widths (num_frames,), like :func:`contour`.

    A width is the distance of the corners relative to the mouth at rest. If they approach each
    other by w, the opening narrows by w squared and keeps its area, as rounded lips do; x counts
    mouth widths at rest. This is not in the paper.
    """
    width = np.clip(widths, *_WIDTH_RANGE)
    points = contour(np.minimum(openings / width**2, MAX_OPENING), num_points)
    for row, name in enumerate(LINES):
        factor = width**2 if name.startswith("inner") else width
        points[:, row, :, 0] = 0.5 + (points[:, row, :, 0] - 0.5) * factor[:, None]
    return points


def opening_to_faps(openings: ArrayLike) -> Doubles:
    """Return the mouth FAPs (num_frames, num_mouth_faps) for openings R (num_frames,), 0 to 5.

    Jaw and lip feature points travel as measured; the other FAPs are 0.
    """
    travels = {point.fap: point.travel for point in load_lip_points().values()}
    travel_of_fap = np.array([travels.get(fap, 0.0) for fap in MOUTH_FAPS])
    faps: Doubles = np.asarray(openings, dtype=np.float64)[:, None] / MAX_OPENING * travel_of_fap
    return faps
