"""The head's lips between their feature points, beside those of plain zones of influence.

Li et al. 2011, section 2.1, move the vertices round each feature point by a raised cosine. Between
the lips' 16 points that leaves bumps. The package's heads interpolate between the points instead,
as smoothly as the surface allows (``services.driver.head.surface.smoothest``): what the Ferguson
curve is to the line of the lips (Zhang et al. 2021, section 3), this is to their surface, and it is
as linear in the points' displacements.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from corpora.figures import new_figure
from services.driver.head.head import Head
from services.driver.head.import_fields import FaceFields
from services.driver.head.surface import Float, Index
from services.driver.render.camera import Camera
from services.driver.render.renderer import Renderer
from services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from services.synthesizer.lips.dynamic_visemes.visemes import VISEMES
from services.synthesizer.lips.ferguson.contour import faps_of
from services.synthesizer.lips.ferguson.motion import MAX_OPENING
from shared.face.faps import MOUTH_FAPS, NUM_FAPS

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


def lip_line_figure() -> Any:
    """Draw the widest opening and /u/, with plain zones and with the fields of any face."""
    head = Head.load()
    target = load_parameters().target
    poses = {
        f"widest opening, R = {MAX_OPENING:g}": faps_of([MAX_OPENING])[0],
        "/u/": target[VISEMES.index("u")],
    }
    figure = new_figure(8.4, 6.4)
    axes = figure.subplots(2, 2)
    for row, (way, shown) in enumerate(
        (("plain zones", with_fields(head, PlainZones)), ("kouxing", with_fields(head, FaceFields)))
    ):
        renderer = Renderer(shown, _WIDTH_PX, _HEIGHT_PX, camera=_CAMERA)
        for axis, (pose, mouth) in zip(axes[row], poses.items(), strict=True):
            faps = np.zeros(NUM_FAPS, dtype=np.float32)
            faps[np.array(MOUTH_FAPS) - 1] = mouth
            axis.imshow(renderer.draw(faps))
            axis.set_title(f"{way}: {pose}", fontsize=10)
            axis.set_axis_off()
        renderer.close()
    return figure
