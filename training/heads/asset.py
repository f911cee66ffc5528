"""Write a head in the file format that ``services.driver.head.head`` reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.head.head import FORMAT
from kouxing.training.heads import parts
from kouxing.training.heads.feature_points import FEATURE_POINTS
from kouxing.training.heads.makehuman import METERS_PER_UNIT, PIVOT
from kouxing.training.heads.zones import Fields, Skin

Float = NDArray[np.float64]
Index = NDArray[np.int64]

TRANSPARENT = ("hair_tips", "lashes")


@dataclass(slots=True)
class Piece:
    """A part with its material and motion."""

    name: str
    part: parts.Part
    texture: str
    roughness: float
    head_weight: Float  # (V,)
    fields: Fields = field(default_factory=dict)  # FAP -> (V, 3), dm at 1 FAPU or 1 rad
    coarse_vertices: int = 0  # 0: there is only one level of detail
    coarse_triangles: Index | None = None


def write(
    output: Path,
    pieces: list[Piece],
    textures: dict[str, bytes],
    skin: Skin,
    tongue: Skin,
    fapu: dict[str, float],
    *,
    cel: bool,
) -> None:
    """Write a head, converting dm to m; ``cel`` as in ``Head``."""

    def meters(points: Float) -> NDArray[np.float32]:
        return np.asarray((points - PIVOT) * METERS_PER_UNIT, dtype=np.float32)

    first = np.cumsum([0] + [len(p.part.vertices) for p in pieces])
    start = {p.name: int(at) for p, at in zip(pieces, first, strict=False)}
    part_vertices, part_triangles, triangles = [], [], []
    count = 0
    for piece in pieces:
        at, size = start[piece.name], len(piece.part.vertices)
        part_vertices.append((at, at + (piece.coarse_vertices or size), at + size))
        triangles.append(piece.part.triangles + at)
        fine = (count, count + len(triangles[-1]))
        count = fine[1]
        coarse = fine
        if piece.coarse_triangles is not None:
            triangles.append(piece.coarse_triangles + at)
            coarse = (count, count + len(triangles[-1]))
            count = coarse[1]
        part_triangles.append((*fine, *coarse))

    eyes = [p.part for p in pieces if p.name.startswith("eye")]
    points = {
        name: start["skin"] + int(skin.number[vertex])
        for name, vertex in FEATURE_POINTS.items()
        if skin.number[vertex] >= 0
    }
    points |= {
        name: start["tongue"] + int(tongue.number[vertex])
        for name, vertex in FEATURE_POINTS.items()
        if tongue.number[vertex] >= 0
    }
    points |= {"3.5": start["eye_left"], "3.6": start["eye_right"]}
    for piece, edge, root in ((pieces[4], "9.10", "9.8"), (pieces[5], "9.11", "9.9")):
        at_edge, at_root = parts.middle_of_teeth(piece.part)
        points |= {edge: start[piece.name] + at_edge, root: start[piece.name] + at_root}
    vertices = np.concatenate([p.part.vertices for p in pieces])
    fapu = {name: value * METERS_PER_UNIT for name, value in fapu.items()} | {"AU": 1e-5}

    faps, units, bounds, moved, shifts = [], [], [0], [], []
    for fap in sorted({fap for piece in pieces for fap in piece.fields}):
        for piece in pieces:
            if fap in piece.fields:
                shift = piece.fields[fap] * METERS_PER_UNIT
                rows = np.flatnonzero(np.abs(shift).max(axis=1) > 2e-6)
                moved.append(rows + start[piece.name])
                shifts.append(shift[rows])
        faps.append(fap)
        units.append(1e5 if fap == 47 else 1024.0)
        bounds.append(sum(len(rows) for rows in moved))
    centers = meters(np.stack([(e.vertices.max(0) + e.vertices.min(0)) / 2 for e in eyes]))
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "cel": np.array(cel),
        "vertices": meters(vertices),
        "uv": np.round(np.concatenate([p.part.uv for p in pieces]) * 65535).astype(np.uint16),
        "colors": np.round(
            np.sqrt(np.clip(np.concatenate([p.part.colors for p in pieces]), 0, 1)) * 255
        ).astype(np.uint8),
        "head_weight": np.round(np.concatenate([p.head_weight for p in pieces]) * 255).astype(
            np.uint8
        ),
        "triangles": np.concatenate(triangles).astype(np.uint16),
        "part_names": np.array([p.name for p in pieces]),
        "part_textures": np.array([p.texture for p in pieces]),
        "part_roughness": np.array([p.roughness for p in pieces]),
        "part_transparent": np.array([p.name in TRANSPARENT for p in pieces]),
        "part_double_sided": np.array([p.texture in ("hair", "lashes") for p in pieces]),
        "part_vertices": np.array(part_vertices),
        "part_triangles": np.array(part_triangles),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(points)),
        "feature_points": np.array(list(points.values())),
        "eye_centres": centers,
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.array(units),
        "field_bounds": np.array(bounds),
        "field_vertices": np.concatenate([*moved, np.zeros(0, int)]).astype(np.uint16),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float16),
    }
    for name, data in textures.items():
        arrays[f"texture_{name}"] = np.frombuffer(data, np.uint8)
    np.savez_compressed(output, allow_pickle=False, **arrays)
