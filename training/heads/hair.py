"""Fit the hair to a head."""

from pathlib import Path

import numpy as np
from scipy import ndimage

from kouxing.shared.arrays import Doubles
from kouxing.training.heads import fitted_mesh, paint, parts, subdivision, textures
from kouxing.training.heads.makehuman import PIVOT
from kouxing.training.heads.parts import HeadPiece
from kouxing.training.heads.people import Person

_HAIR_TEXTURES = {"afro01": "afro"}
# styles with a fringe over the right eye: its distance from the head's axis at the side, dm, and
# the fraction by which it is lifted off the forehead
_FRINGES = {"bob01": (0.73, 0.0), "bob02": (0.73, 0.03)}
_SOFT_EDGE = 7  # texels across the edges of strands that may blend
_COARSE_HAIR = 1800  # quads; hair with fewer quads is subdivided
# quads; smaller strands of these styles hang in front of the skin, and are removed
_LOOSE_STRANDS = {"bob01": 60, "bob02": 60, "short04": 10}
_SWEEP = 0.62  # fraction of the angle to the right ear by which it is turned
_WIDEST_HAIR = 5.9  # height, dm


def strand_texture(folder: Path, person: Person) -> Doubles:
    """Return the texture of the hair (H, W, 2); the strands of gray hair differ less."""
    style = person.hair
    file = f"hair/{style}/{_HAIR_TEXTURES.get(style, style)}_diffuse.png"
    contrast = 0.5 if person.look.cel else 1.5 - np.mean(person.look.hair)
    return textures.strands(textures.load(folder, file), float(contrast))


def hair_piece(
    folder: Path, person: Person, vertices: Doubles, right_eye: Doubles, alpha: Doubles
) -> HeadPiece:
    """Return hair that is fitted to the vertices of a head, with its triangles in drawing order.

    Opaque triangles come first, from the outside inward, so that they hide others before these
    are shaded. Translucent ones follow from the inside outward, so that outer strands blend
    over inner ones. Triangles without strands are removed; they would cast shadows. ``alpha``
    (H, W) is the alpha channel of the texture, and ``right_eye`` the center of the eye (3,), dm.
    """
    hair = fitted_mesh.read(folder, f"hair/{person.hair}/{person.hair}")
    points = hair.fit(vertices)
    # a crown that narrows evenly toward its top looks pointed
    height = (points[:, 1] - _WIDEST_HAIR) / (points[:, 1].max() - _WIDEST_HAIR)
    crown = 1 + person.crown * np.sin(np.pi * np.clip(height, 0, 1) ** 1.7)
    points[:, 0] *= person.hair_width * crown
    if person.hair in _FRINGES:
        points = _swept_aside(points, right_eye, *_FRINGES[person.hair])
    quads, uv, welds = hair.quads, hair.uv, hair.welds
    if person.hair in _LOOSE_STRANDS:
        size = subdivision.patch_sizes(welds[quads])
        quads = quads[size >= _LOOSE_STRANDS[person.hair]]
    if len(quads) < _COARSE_HAIR:
        points, quads, uv, welds = subdivision.smooth_strands(points, quads, uv, welds)
    triangles = subdivision.triangles_of(quads)
    triangles = triangles[(textures.sample_alpha(triangles, uv, alpha) > 0.25).any(axis=1)]
    inner = ndimage.minimum_filter(alpha, _SOFT_EDGE)
    opaque = (textures.sample_alpha(triangles, uv, inner) > 0.9).all(axis=1)
    middle = points[triangles].mean(axis=1) - PIVOT
    outward = np.hypot(middle[:, 0], middle[:, 2]) + middle[:, 2]
    triangles = triangles[np.lexsort([np.where(opaque, -outward, outward), ~opaque])]
    used, triangles, welds = subdivision.used_vertices(triangles, welds)
    color = np.tile(textures.tint(person.look.hair), (len(used), 1))
    geometry = parts.Geometry(points[used], triangles, uv[used], color, welds)
    return HeadPiece("hair", geometry, "hair", 0.6, np.ones(len(used)))


def _swept_aside(points: Doubles, right_eye: Doubles, width: float, lifted: float) -> Doubles:
    """Turn a fringe that covers the right eye to the side, and lift it off the forehead."""
    x, y, z = points.T
    depth = z - paint.AXIS_Z
    turn = np.arctan2(x, depth)
    low = np.clip((right_eye[1] + 0.55 - y) / 0.5, 0, 1)
    low = low * low * (3 - 2 * low)
    swept_part = np.clip(turn + np.pi / 2, 0, None) * np.clip((0.6 - turn) / 0.6, 0, 1) * low
    turned = turn - _SWEEP * swept_part

    def reach(angle: Doubles) -> Doubles:
        return 1 / np.hypot(np.sin(angle) / width, np.cos(angle) / 1.0)

    radius = np.hypot(x, depth) * reach(turned) / reach(turn)
    swept = np.stack([radius * np.sin(turned), y, paint.AXIS_Z + radius * np.cos(turned)], 1)
    swept = np.where((swept_part > 0)[:, None], swept, points)
    x, depth = swept[:, 0], swept[:, 2] - paint.AXIS_Z
    front = np.clip((1.3 - np.abs(np.arctan2(x, depth) + 0.2)) / 0.5, 0, 1)
    above = y - right_eye[1]
    front *= np.clip((1.0 - above) / 0.4, 0, 1) * np.clip((above + 0.2) / 0.3, 0, 1)
    outward = (lifted * front)[:, None] * np.stack([x, np.zeros_like(x), depth], axis=1)
    return np.asarray(swept + outward)
