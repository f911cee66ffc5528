"""The head's lips between their feature points, beside those of plain zones of influence.

Li et al. 2011, section 2.1, move the vertices round each feature point by a raised cosine. Between
the lips' 16 points that leaves bumps. The package's heads interpolate between the points instead,
as smoothly as the surface allows (``services.driver.head.surface.smoothest``): what the Ferguson
curve is to the line of the lips (Zhang et al. 2021, section 3), this is to their surface, and it is
as linear in the points' displacements.

How far the outer lip lines are from smooth is measured on the skin's vertices that lie on them at
rest: the distance between where each moves and where the cubic spline through the line's five
points has it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy import sparse
from scipy.interpolate import CubicSpline

from kouxing.corpora.figures import new_figure
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.head.import_fields import FaceFields
from kouxing.services.driver.head.surface import Float, Index
from kouxing.services.driver.render.camera import Camera
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEMES
from kouxing.services.synthesizer.lips.ferguson.contour import LINES, faps_of
from kouxing.services.synthesizer.lips.ferguson.motion import MAX_OPENING
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

_NEAR_M = 2e-3  # a vertex so near to a line at rest lies on it
_WIDTH_PX, _HEIGHT_PX = 420, 300
_CAMERA = Camera(position=(0.0, -0.03, 0.62), target=(0.0, -0.043, 0.0), field_of_view_deg=6.0)


class PlainZones(FaceFields):
    """The same fields, with a raised cosine round each point of the lips."""

    def _smoothest(self, points: Index, fixed: NDArray[np.bool_]) -> Float:
        held = np.setdiff1d(np.flatnonzero(fixed), points)
        weights = [
            self._geodesics.zone(point, np.union1d(held, np.setdiff1d(points, point)))
            for point in points.reshape(-1, 1)
        ]
        return np.stack(weights, axis=1)


WAYS: dict[str, type[FaceFields]] = {"plain zones": PlainZones, "kouxing": FaceFields}


def with_fields(head: Head, kind: type[FaceFields]) -> Head:
    """Replace what the FAPs of lips and jaw do to the skin."""
    skin = head.part("skin")
    # vertices at the seams of the texture stand twice
    vertices, welded = np.unique(head.vertices[skin.vertices], axis=0, return_inverse=True)
    triangles = welded[head.triangles[skin.triangles].astype(np.int64) - skin.vertices.start]
    points = {
        name: int(welded[vertex - skin.vertices.start])
        for name, vertex in head.feature_points.items()
        if skin.vertices.start <= vertex < skin.vertices.stop
    }
    made = kind(
        vertices.astype(float), triangles, points, head.eye_centres.astype(float), head.fapu
    )
    basis = head.basis.tolil()
    rows = slice(3 * skin.vertices.start, 3 * skin.vertices.stop)
    for fap in MOUTH_FAPS:
        if fap in made.fields:
            basis[rows, fap - 1] = made.fields[fap][welded].reshape(-1, 1)
    return replace(head, basis=sparse.csr_array(basis).astype(np.float32))


def poses() -> dict[str, NDArray[np.float32]]:
    """Return the FAPs (68,) of the widest opening and of /u/."""
    mouths = {
        f"widest opening, R = {MAX_OPENING:g}": faps_of([MAX_OPENING])[0],
        "/u/": load_parameters().target[VISEMES.index("u")],
    }
    faps = np.zeros((len(mouths), NUM_FAPS), dtype=np.float32)
    faps[:, np.array(MOUTH_FAPS) - 1] = list(mouths.values())
    return dict(zip(mouths, faps, strict=True))


def away_from_spline(head: Head, faps: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how far vertices of the outer lip lines are from smooth ones, mm, (num_vertices,)."""
    skin = head.part("skin").vertices
    rest = head.vertices.astype(float)
    moves = head.deform(faps).astype(float) - rest
    distances = []
    for line in ("outer upper", "outer lower"):
        points = [head.feature_points[name] for name in LINES[line]]
        x = rest[points, 0]
        place, move = (CubicSpline(x, y, bc_type="natural") for y in (rest[points], moves[points]))
        x_of_skin = np.clip(rest[skin, 0], x[0], x[-1])
        is_near = np.linalg.norm(rest[skin] - place(x_of_skin), axis=1) < _NEAR_M
        apart = moves[skin][is_near] - move(x_of_skin[is_near])
        distances.append(np.linalg.norm(apart, axis=1))
    return 1e3 * np.concatenate(distances)


def print_lip_lines(console: Console) -> None:
    """Print how far the lip lines of plain zones, and those of the heads, are from smooth ones."""
    head = Head.load()
    table = Table("lip lines: distance from the spline, mm", "mean", "95th percentile", "largest")
    for way, kind in WAYS.items():
        shown = with_fields(head, kind)
        for pose, faps in poses().items():
            away = away_from_spline(shown, faps)
            figures = (away.mean(), np.percentile(away, 95), away.max())
            table.add_row(f"{way}, {pose}", *(f"{figure:.2f}" for figure in figures))
    console.print(table)


def lip_line_figure() -> Any:
    """Draw the widest opening and /u/, with plain zones and with the fields of any face."""
    head = Head.load()
    figure = new_figure(8.4, 6.4)
    axes = figure.subplots(2, 2)
    for row, (way, kind) in enumerate(WAYS.items()):
        renderer = Renderer(with_fields(head, kind), _WIDTH_PX, _HEIGHT_PX, camera=_CAMERA)
        for axis, (pose, faps) in zip(axes[row], poses().items(), strict=True):
            axis.imshow(renderer.draw(faps))
            axis.set_title(f"{way}: {pose}", fontsize=10)
            axis.set_axis_off()
        renderer.close()
    return figure
