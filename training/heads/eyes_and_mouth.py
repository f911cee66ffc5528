"""The pieces behind the skin: eyes, teeth and tongue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.driver.head import surface
from training.heads import parts
from training.heads.asset import Piece
from training.heads.makehuman import BaseMesh
from training.heads.measures import eye_centres, eye_radius
from training.heads.zones import Skin, jaw_fields, tongue_fields

Float = NDArray[np.float64]


def eye_pieces(vertices: Float, mesh: BaseMesh, fapu: dict[str, float]) -> list[Piece]:
    """Make the two eyeballs; they move forward, and their pupils grow."""
    pieces = []
    for row, name in enumerate(("eye_left", "eye_right")):
        centre = eye_centres(vertices, mesh)[row]
        part = parts.eyeball(centre, eye_radius(vertices, mesh))
        count = len(part.vertices)
        fields = {
            27 + row: np.tile([0.0, 0.0, fapu["ES"]], (count, 1)),
            29 + row: parts.pupil_growth(part, centre) * fapu["IRISD"] / 2,
        }
        pieces.append(Piece(name, part, "eye", 0.12, np.ones(count), fields))
    return pieces


def teeth_pieces(fapu: dict[str, float]) -> list[Piece]:
    """Make the upper and the lower teeth; the lower ones move with the jaw."""
    pieces = []
    for name, widths, edge, front, up in (
        ("teeth_upper", parts.UPPER_TEETH, 5.158, 1.222, 1.0),
        ("teeth_lower", parts.LOWER_TEETH, 5.162, 1.188, -1.0),
    ):
        part = parts.tooth_row(widths, edge, front, up)
        still = np.ones(len(part.vertices))
        fields = jaw_fields(part.vertices, still, fapu) if up < 0 else {}
        pieces.append(Piece(name, part, name, 0.35, still, fields))
    return pieces


def tongue_piece(tongue: Skin, fapu: dict[str, float]) -> Piece:
    """Make the tongue."""
    points = tongue.vertices * [1.2, 1.0, 1.0] + [0.0, -0.045, -0.03]
    uv = np.clip(points[:, [0, 2]] * [1.2, 0.8] + [0.5, -0.3], 0, 1)
    tint = np.clip((points[:, 2] - 0.55) / 0.6, 0.15, 1.0)[:, None] * [0.85, 0.7, 0.7]
    part = parts.Part(points, surface.triangles_of(tongue.quads), uv, tint)
    return Piece(
        "tongue",
        part,
        "tongue",
        0.4,
        np.ones(len(points)),
        tongue_fields(tongue, fapu),
        coarse_vertices=len(tongue.base),
        coarse_triangles=surface.triangles_of(tongue.coarse_quads),
    )
