"""The pieces behind the skin: eyes, teeth and tongue."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.training.heads import parts, subdivision
from kouxing.training.heads.asset import Piece
from kouxing.training.heads.makehuman import BaseMesh
from kouxing.training.heads.measures import eye_centers, eye_radius
from kouxing.training.heads.zones import Skin, jaw_fields, tongue_fields

Float = NDArray[np.float64]


def eye_pieces(vertices: Float, mesh: BaseMesh, fapu: dict[str, float]) -> list[Piece]:
    """Make the eyeballs; they can move forward, and their pupils can grow."""
    pieces = []
    for row, name in enumerate(("eye_left", "eye_right")):
        center = eye_centers(vertices, mesh)[row]
        part = parts.eyeball(center, eye_radius(vertices, mesh))
        count = len(part.vertices)
        fields = {
            27 + row: np.tile([0.0, 0.0, fapu["ES"]], (count, 1)),
            29 + row: parts.pupil_growth(part, center) * fapu["IRISD"] / 2,
        }
        pieces.append(Piece(name, part, "eye", 0.12, np.ones(count), fields))
    return pieces


def teeth_pieces(fapu: dict[str, float]) -> list[Piece]:
    """Make the upper and the lower teeth; the lower teeth move with the jaw."""
    pieces = []
    for name, widths, edge, front, up in (
        ("teeth_upper", parts.UPPER_TEETH, 5.144, 1.238, 1.0),
        ("teeth_lower", parts.LOWER_TEETH, 5.146, 1.206, -1.0),
    ):
        part = parts.tooth_row(widths, edge, front, up)
        still = np.ones(len(part.vertices))
        fields = jaw_fields(part.vertices, still, fapu) if up < 0 else {}
        pieces.append(Piece(name, part, name, 0.35, still, fields))
    return pieces


def tongue_piece(tongue: Skin, fapu: dict[str, float]) -> Piece:
    """Make the tongue: wide, flat behind the lower teeth, grooved along its middle."""
    x, y, z = tongue.vertices.T
    top = np.clip((y - 5.15) / 0.05, 0, 1)
    to_tip = np.clip((z - 0.56) / 0.59, 0, 1)
    groove = 0.014 * np.exp(-((x / 0.045) ** 2)) * top * np.clip(3 * (1 - to_tip), 0, 1)
    sunk = 0.110 - 0.052 * to_tip**2 + groove + 0.02 * np.abs(x) / 0.19
    points = np.stack([1.28 * x, y - sunk, z - 0.03], axis=1)
    uv = np.clip(points[:, [0, 2]] * [1.8, 1.4] + [0.5, -0.65], 0, 1)
    part = parts.Part(points, subdivision.triangles_of(tongue.quads), uv, np.ones_like(points))
    return Piece(
        "tongue",
        part,
        "tongue",
        0.4,
        np.ones(len(points)),
        tongue_fields(tongue, fapu),
        coarse_vertices=len(tongue.base),
        coarse_triangles=subdivision.triangles_of(tongue.coarse_quads),
    )
