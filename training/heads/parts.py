"""Eyeballs and teeth, which MakeHuman's base mesh lacks or has too coarse.

All lengths are MakeHuman decimeters, y up, z toward the viewer, x to the subject's left.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(slots=True)
class Part:
    """Geometry of one piece of the head."""

    vertices: Float  # (V, 3)
    triangles: Index  # (F, 3)
    uv: Float  # (V, 2), v downward as in glTF
    colors: Float  # (V, 3) linear factors on the texture


def grid_triangles(rows: int, columns: int) -> Index:
    """Triangulate a grid of ``rows * columns`` vertices, row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    halves = [
        np.stack([corner, corner + columns, corner + columns + 1], axis=1),
        np.stack([corner, corner + columns + 1, corner + 1], axis=1),
    ]
    return np.stack(halves, axis=1).reshape(-1, 3)


IRIS_ANGLE = np.radians(25.0)  # half of the iris, seen from the eye's center
PUPIL_ANGLE = np.radians(9.5)
# rings of vertices from the front pole backward; ring 2 is the pupil's edge, ring 6 the iris's
EYE_RINGS = np.radians([0.0, 5.0, 9.5, 13.0, 17.0, 21.0, 25.0, 30.0, 38.0, 48.0, 60.0, 75.0, 95.0])
_EYE_SEGMENTS = 32


def eyeball(center: Float, radius: float) -> Part:
    """Make a sphere, open at the back; its texture is a view from the front."""
    turn = np.linspace(0.0, 2 * np.pi, _EYE_SEGMENTS + 1)
    angle, turn = np.meshgrid(EYE_RINGS, turn, indexing="ij")
    bulge = 1.0 + 0.035 * np.clip(1 - angle / np.radians(32.0), 0, 1) ** 1.0  # the cornea
    direction = np.stack(
        [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=2
    )
    vertices = center + radius * (bulge[..., None] * direction).reshape(-1, 3)
    reach = (angle / EYE_RINGS[-1]).ravel()  # the texture's radius is proportional to the angle
    uv = 0.5 + 0.5 * np.stack([reach * np.cos(turn).ravel(), -reach * np.sin(turn).ravel()], axis=1)
    triangles = grid_triangles(*angle.shape)
    return Part(vertices, triangles, uv, np.ones((len(vertices), 3)))


def pupil_growth(part: Part, center: Float) -> Float:
    """Return radial directions (V, 3), of unit length at the pupil's edge, for FAPs 29 and 30."""
    angle = np.repeat(EYE_RINGS, _EYE_SEGMENTS + 1)
    weight = np.interp(angle, [0.0, PUPIL_ANGLE, IRIS_ANGLE], [0.0, 1.0, 0.0])
    outward = (part.vertices - center) * [1.0, 1.0, 0.0]
    length = np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    return weight[:, None] * outward / length


# widths in mm from the middle outward: incisors, canine, premolars, molars
UPPER_TEETH = (8.4, 6.6, 7.4, 6.8, 6.6, 9.5, 9.0)
LOWER_TEETH = (5.4, 5.8, 6.6, 6.9, 7.0, 10.0, 9.5)
_TOOTH_COLUMNS = 6
_ARCH_HALF_WIDTH, _ARCH_DEPTH = 0.300, 0.44  # of half an ellipse, dm
# profile of a row of teeth from the front gum over the cutting edge to the back:
# (outward, away from the edge, texture row)
_PROFILE = np.array(
    [
        [-0.035, 0.185, 0.00],
        [-0.004, 0.135, 0.16],
        [0.006, 0.095, 0.32],
        [0.006, 0.055, 0.48],
        [0.000, 0.018, 0.62],
        [-0.008, 0.002, 0.70],
        [-0.022, 0.004, 0.76],
        [-0.042, 0.045, 0.84],
        [-0.060, 0.130, 1.00],
    ]
)


def tooth_row(widths: tuple[float, ...], edge_y: float, front_z: float, up: float) -> Part:
    """Sweep the profile of a tooth along the dental arch.

    ``widths`` are those of one half in mm, outward. The cutting edge of the front teeth is at
    ``edge_y`` and ``front_z``. ``up`` is 1 if the gum is above the edge, -1 if below.
    """
    half = np.concatenate([[0.0], np.cumsum(widths)]) / 100.0
    bounds = np.concatenate([-half[:0:-1], half])
    place = np.concatenate(
        [np.linspace(a, b, _TOOTH_COLUMNS, endpoint=False) for a, b in pairwise(bounds)]
        + [bounds[-1:]]
    )
    phase = np.concatenate([np.tile(np.arange(_TOOTH_COLUMNS), 2 * len(widths)), [0]])
    swell = np.sin(np.pi * phase / _TOOTH_COLUMNS)  # 0 between two teeth, 1 in the middle of one

    # the arch: half an ellipse, parametrized by its length
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    arch = np.stack([_ARCH_HALF_WIDTH * np.sin(angle), _ARCH_DEPTH * np.cos(angle)], axis=1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(arch, axis=0), axis=1))])
    length -= length[-1] / 2
    at = np.interp(place, length, angle)
    x, z = _ARCH_HALF_WIDTH * np.sin(at), front_z - _ARCH_DEPTH + _ARCH_DEPTH * np.cos(at)
    outward = np.stack(
        [np.sin(at) / _ARCH_HALF_WIDTH, np.zeros_like(at), np.cos(at) / _ARCH_DEPTH], axis=1
    )
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)

    back = np.abs(place) / half[-1]
    rows = []
    for out, away, _ in _PROFILE:
        on_tooth = np.clip(1 - away / 0.1, 0, 1)
        lift = away + 0.010 * (1 - swell) ** 2 * np.clip(1 - away / 0.03, 0, 1)
        lift = lift + 0.012 * back**2  # the row rises toward the molars
        push = out + 0.010 * (swell - 1) * (0.3 + on_tooth)
        point = np.stack([x, edge_y + up * lift, z], axis=1) + outward * push[:, None]
        rows.append(point)
    vertices = np.concatenate(rows)
    columns = len(place)
    uv = np.stack(
        [np.tile(place / half[-1] * 0.5 + 0.5, len(rows)), np.repeat(_PROFILE[:, 2], columns)],
        axis=1,
    )
    triangles = grid_triangles(len(rows), columns)
    if up > 0:
        triangles = triangles[:, ::-1]
    shade = np.clip(1.0 - 0.95 * np.tile(back, len(rows)) ** 1.2, 0.06, 1.0)
    by_row = np.interp(_PROFILE[:, 2], [0.0, 0.3, 0.7, 1.0], [0.45, 0.9, 1.0, 0.4])
    shade *= np.repeat(by_row, columns)
    return Part(vertices, triangles, uv, np.repeat(shade[:, None], 3, axis=1))


def middle_of_teeth(row: Part) -> tuple[int, int]:
    """Find the vertices between the middle teeth, at the cutting edge and at the gum."""
    columns = len(row.vertices) // len(_PROFILE)
    edge = int(np.argmin(np.abs(_PROFILE[:, 1])))
    return edge * columns + columns // 2, columns // 2
