"""The lip contour and the FAPs at an opening R.

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

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from kouxing.services.synthesizer.lips.ferguson.table import MAX_OPENING
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, MOUTH_FAPS

Array = NDArray[np.float64]

# feature points from the subject's right to the left
LINES = {
    "outer upper": ("8.4", "8.6", "8.1", "8.5", "8.3"),
    "inner upper": ("2.5", "2.7", "2.2", "2.6", "2.4"),
    "inner lower": ("2.5", "2.9", "2.3", "2.8", "2.4"),
    "outer lower": ("8.4", "8.8", "8.2", "8.7", "8.3"),
}
_ONLY_CLOSED = {"outer upper": ("8.9", "8.10")}  # points of the closed line without travel
_MOUTH_WIDTHS_PER_MNS = 0.39  # of the head "woman"
_MAX_TRAVEL = 1500.0  # FAP units
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

    @property
    def ends(self) -> tuple[float, float]:
        """X of both corners, mouth widths."""
        return float(self.travel.x[0]), float(self.travel.x[-1])

    def heights(self, x: ArrayLike, openings: ArrayLike) -> Array:
        """Return l (num_frames, num_points) at x (num_points,) for R (num_frames,)."""
        opening = np.asarray(openings, dtype=np.float64)[:, None]
        heights: Array = self.closed(x) + opening * self.travel(x)  # Zhang 2021, eq. 4
        return heights


@lru_cache
def lip_points() -> dict[str, LipPoint]:
    """Return the points of ``lip_points.tsv`` by name."""
    return parse_lip_points((resources.files(__package__) / "lip_points.tsv").read_text("utf-8"))


def parse_lip_points(text: str) -> dict[str, LipPoint]:
    """Read points from the text of a table.

    Raises
    ------
    UserError
        If a point is missing, out of order, moved by a FAP of another point, or out of range.
    """
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    points = {}
    for row in csv.DictReader(lines, delimiter="\t"):
        try:
            points[row["point"]] = LipPoint(
                float(row["x"]),
                float(row["y"]),
                int(row["fap"]) if row["fap"] else None,
                float(row["travel"] or 0.0),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"the lip feature points are damaged: {row}: {error!r}") from None
    for name, point in points.items():
        if point.fap is not None and (
            point.fap not in MOUTH_FAPS or name not in FAPS[point.fap - 1].feature_points
        ):
            raise UserError(
                f"the lip feature points are damaged: FAP {point.fap} does not move {name}"
            )
        if not (abs(point.travel) <= _MAX_TRAVEL and np.isfinite([point.x, point.y]).all()):
            raise UserError(f"the lip feature points are damaged: {name} is out of range")
    for line, members in LINES.items():
        x = [points[name].x for name in members if name in points and points[name].fap]
        if len(x) < len(members) or not (np.diff(x) > 0.0).all():
            raise UserError(
                f"the lip feature points are damaged: the {line} line needs {', '.join(members)}"
                " from right to left, each with its FAP"
            )
    return points


@lru_cache
def lip_lines() -> dict[str, LipLine]:
    """Return the four lines by name."""
    return {name: _line(name) for name in LINES}


def _line(name: str) -> LipLine:
    points = lip_points()
    moving = [points[point] for point in LINES[name]]
    all_points = (*LINES[name], *_ONLY_CLOSED.get(name, ()))
    closed = sorted((points[point] for point in all_points), key=lambda point: point.x)
    return LipLine(
        _ferguson([point.x for point in closed], [point.y for point in closed]),
        _ferguson([point.x for point in moving], [point.rise for point in moving]),
    )


def _ferguson(x: list[float], y: list[float]) -> CubicSpline:
    return CubicSpline(x, y, bc_type="natural")


def contour(openings: ArrayLike, num_points: int = 41) -> Array:
    """Return the lip contour for openings R (num_frames,), 0 to 5.

    Returns
    -------
    Points x, y in mouth widths, shape (num_frames, 4, num_points, 2): lines as in ``LINES``, points
    evenly spaced along x.

    Raises
    ------
    ValueError
        If an opening is out of range, or ``num_points`` is less than 2.

    Examples
    --------
    >>> contour([0.0, 5.0], num_points=9).shape
    (2, 4, 9, 2)
    """
    opening = _checked(openings)
    if num_points < 2:
        raise ValueError(f"num_points is {num_points}; give at least 2")
    points = np.empty((len(opening), len(LINES), num_points, 2))
    for row, line in enumerate(lip_lines().values()):
        x = np.linspace(*line.ends, num_points)
        points[:, row, :, 0] = x
        points[:, row, :, 1] = line.heights(x, opening)
    return points


def faps_of(openings: ArrayLike) -> Array:
    """Return the mouth FAPs (num_frames, num_mouth_faps) for openings R (num_frames,), 0 to 5.

    Jaw and lip feature points travel as measured; the other FAPs are 0.

    Raises
    ------
    ValueError
        If an opening is out of range.
    """
    travels = {point.fap: point.travel for point in lip_points().values()}
    whole = np.array([travels.get(fap, 0.0) for fap in MOUTH_FAPS])
    faps: Array = _checked(openings)[:, None] / MAX_OPENING * whole
    return faps


def _checked(openings: ArrayLike) -> Array:
    opening = np.asarray(openings, dtype=np.float64)
    if opening.ndim != 1:
        raise ValueError(f"expected openings of shape (num_frames,), got {opening.shape}")
    if not ((opening >= 0.0) & (opening <= MAX_OPENING)).all():
        raise ValueError(f"openings must be between 0 and {MAX_OPENING:g}")
    return opening
