"""Pieces of a mesh, and their conversion to the parts of a head."""

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver import picture
from kouxing.services.driver.head.head import FORMAT
from kouxing.shared.arrays import Doubles, Integers

_MIN_SHIFT_M = 2e-9  # smaller displacements by one FAP unit are omitted
_WHITE = np.full((2, 2, 3), 255, np.uint8)
_NODES = ("kouxing", "body", "head")  # nodes of an exported GLB that are not parts
_MAX_NAME_LENGTH = 60

FapFields = dict[int, Doubles]  # FAP: displacements (V, 3) by one unit, m


@dataclass(slots=True)
class MeshPiece:
    """A part of a mesh with one material (a glTF primitive), in scene axes."""

    name: str
    vertices: Doubles
    triangles: Integers
    uv: Doubles
    colors: Doubles
    texture: bytes
    material: dict[str, Any]
    head_weight: Doubles | None  # None without a skeleton
    shapes: dict[str, Doubles] = field(default_factory=dict)  # displacements by name
    rest: dict[str, float] = field(default_factory=dict)  # weights of shapes in the mesh at rest
    is_mirrored: bool = False  # by a negative scale: its triangles face inwards
    jaw_arm: Doubles | None = None  # positions relative to a jaw bone, times its weights


def weld(vertices: NDArray[Any], uv: NDArray[Any]) -> Integers:
    """Return for each vertex (V,) the first vertex at the same position.

    Vertices whose texture coordinates are also equal stay separate. Programs write such duplicates
    only for a slit, such as between closed lips.
    """
    _, first, inverse = np.unique(
        np.round(vertices / 1e-6).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    inverse = inverse.ravel()
    both = np.concatenate([inverse[:, None], np.round(uv * 65535)], axis=1)
    _, kind, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
    doubled = np.zeros(len(first), dtype=bool)
    doubled[inverse[count[kind.ravel()] > 1]] = True
    return np.where(doubled[inverse], np.arange(len(vertices)), first[inverse])


def part_names(pieces: list[MeshPiece]) -> list[str]:
    """Return a unique name for each part; eyeballs get the names that the package uses."""
    names: list[str] = []
    taken, last = set(_NODES), dict[str, int]()
    for piece in pieces:
        word = piece.name.lower()
        name = re.sub(r"[^\w-]", "_", piece.name)[:_MAX_NAME_LENGTH]
        if "eye" in word and not re.search("brow|lash|lid|wear|glass", word):
            for side, short in (("left", "l"), ("right", "r")):
                if side in word or re.search(rf"(^|[_. ]){short}([_. ]|$)", word):
                    name = f"eye_{side}"
        unique = name
        while unique in taken:
            last[name] = last.get(name, 1) + 1
            unique = f"{name}_{last[name]}"
        taken.add(unique)
        names.append(unique)
    return names


def pack_head(
    pieces: list[MeshPiece],
    *,
    fields: list[FapFields],
    head_weight: Doubles,
    fapu: dict[str, float],
    feature_points: dict[str, int],
    eye_centers: Doubles,
) -> dict[str, NDArray[Any]]:
    """Convert pieces, in the head's axes, m, to the arrays of a head file (``assemble_head``).

    ``fields`` has the fields of each piece. For the other parameters, see ``Head``.
    """
    first = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    bounds = np.cumsum([0] + [len(piece.triangles) for piece in pieces])
    faps, ends, moved, shifts = [], [0], [], []
    for fap in sorted({fap for piece_fields in fields for fap in piece_fields}):
        for piece_fields, start in zip(fields, first, strict=False):
            if fap in piece_fields:
                rows = np.flatnonzero(np.abs(piece_fields[fap]).max(axis=1) > _MIN_SHIFT_M)
                moved.append(rows + start)
                shifts.append(piece_fields[fap][rows])
        faps.append(fap)
        ends.append(sum(map(len, moved)))
    textures = {"plain": picture.encode(_WHITE)}
    names = []
    for piece in pieces:
        same = [name for name, data in textures.items() if data == piece.texture]
        names.append("plain" if not piece.texture else (same or [f"image {len(textures)}"])[0])
        textures.setdefault(names[-1], piece.texture)
    materials = [piece.material for piece in pieces]
    surfaces = [material.get("pbrMetallicRoughness", {}) for material in materials]
    vertices = np.concatenate([piece.vertices for piece in pieces]).astype(np.float32)
    uv = np.concatenate([piece.uv for piece in pieces]).astype(np.float32)
    colors = np.clip(np.concatenate([piece.colors for piece in pieces]), 0, 1)
    triangles = [piece.triangles + offset for piece, offset in zip(pieces, first, strict=False)]
    return {
        "format": np.array(FORMAT),
        "vertices": vertices,
        "welds": weld(vertices, uv).astype(np.uint32),
        "uv": uv * np.float32(65535),
        "colors": (np.sqrt(colors) * 255).astype(np.float32),
        "head_weight": (head_weight * 255).astype(np.float32),
        "triangles": np.concatenate(triangles).astype(np.uint32),
        "part_names": np.array(part_names(pieces)),
        "part_textures": np.array(names),
        "part_roughness": np.clip([float(s.get("roughnessFactor", 0.6)) for s in surfaces], 0, 1),
        "part_transparent": np.array([m.get("alphaMode", "OPAQUE") != "OPAQUE" for m in materials]),
        "part_double_sided": np.array([bool(m.get("doubleSided", False)) for m in materials]),
        "part_vertices": np.stack([first[:-1], first[1:], first[1:]], axis=1),
        "part_triangles": np.stack([bounds[:-1], bounds[1:], bounds[:-1], bounds[1:]], axis=1),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(feature_points), dtype=str),
        "feature_points": np.array(list(feature_points.values()), dtype=np.int64),
        "eye_centres": eye_centers.astype(np.float32),
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.ones(len(faps)),
        "field_bounds": np.array(ends),
        "field_vertices": np.concatenate([*moved, np.zeros(0, np.int64)]).astype(np.uint32),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float32),
        **{f"texture_{key}": np.frombuffer(data, np.uint8) for key, data in textures.items()},
    }
