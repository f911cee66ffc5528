"""Reads MakeHuman's hair, brows, lashes and teeth (CC0), which are fitted to its base mesh.

A file ``.mhclo`` gives each vertex of its ``.obj`` as three vertices of the base mesh with weights,
and an offset that scales with the head. The parts therefore follow the shape of every head, and
the displacements of every morph.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content
from kouxing.training.heads import subdivision
from kouxing.training.heads.makehuman import read_obj

REPOSITORY = "https://github.com/makehumancommunity/makehuman-assets"


@dataclass(slots=True)
class FittedMesh:
    """A mesh that is fitted to the base mesh. Vertices are split at the seams of the texture."""

    triangles: Integers  # (F, 3)
    uv: Doubles  # (V, 2), v downward
    welds: Integers  # (V,), first vertex at the same position
    base: Integers  # (V, 3), vertices of the base mesh
    weights: Doubles  # (V, 3)
    offsets: Doubles  # (V, 3), relative to the scale
    scale: Doubles  # (3, 3): for each axis two vertices of the base mesh, and their distance, dm

    @property
    def quads(self) -> Integers:
        """Quads (F / 2, 4), for a mesh of quads only, such as hair."""
        first, second = np.split(self.triangles, 2)
        return np.column_stack([first, second[:, 2]])

    def fit(self, vertices: Doubles) -> Doubles:
        """Return the vertices (V, 3) on a shape (19158, 3) of the base mesh, dm."""
        first, second = self.scale[:, 0].astype(int), self.scale[:, 1].astype(int)
        axes = np.arange(3)
        size = np.abs(vertices[first, axes] - vertices[second, axes]) / self.scale[:, 2]
        return np.asarray(self.transfer(vertices) + self.offsets * size)

    def transfer(self, field: Doubles) -> Doubles:
        """Transfer displacements (19158, 3) of the base mesh to the vertices (V, 3)."""
        return np.asarray(np.einsum("vk,vkd->vd", self.weights, field[self.base]))

    def keep_triangles(self, mask: Mask) -> "FittedMesh":
        """Return the triangles (F,) that are kept, without unused vertices."""
        used, triangles, welds = subdivision.used_vertices(self.triangles[mask], self.welds)
        return FittedMesh(
            triangles,
            self.uv[used],
            welds,
            self.base[used],
            self.weights[used],
            self.offsets[used],
            self.scale,
        )


def read(folder: Path, name: str) -> FittedMesh:
    """Read a part by its path in a folder of MakeHuman's assets, such as ``hair/bob01/bob01``.

    Raises ``UserError`` if its files are missing or damaged.
    """
    mesh, fitting = (find(folder, name + suffix) for suffix in (".obj", ".mhclo"))
    with check_content(fitting, "a part of MakeHuman"):
        base, weights, offsets, scale = _fitting(fitting.read_text(encoding="utf-8"))
        quads, uv, vertex = _split_at_seams(mesh.read_text(encoding="utf-8"))
    corner = [0, 1, 2], [0, 2, 3]
    triangles = np.concatenate([quads[:, order] for order in corner])
    triangles = triangles[triangles[:, 0] != triangles[:, 2]]
    _, first, same = np.unique(vertex, return_index=True, return_inverse=True)
    return FittedMesh(
        triangles, uv, first[same], base[vertex], weights[vertex], offsets[vertex], scale
    )


def find(folder: Path, name: str) -> Path:
    """Return the path of a file; UserError if it is missing."""
    path = folder / name
    if not path.is_file():
        raise UserError(f"{path} is missing; set --parts to the folder `base` of {REPOSITORY}")
    return path


def _fitting(text: str) -> tuple[Integers, Doubles, Doubles, Doubles]:
    """Return vertices of the base mesh, weights, offsets, and scale, see ``FittedMesh``."""
    scale = np.zeros((3, 3))
    rows = []
    in_rows = False
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["verts"]:
            in_rows = True
        elif words and words[0] in ("x_scale", "y_scale", "z_scale"):
            scale["xyz".index(words[0][0])] = [float(word) for word in words[1:4]]
        elif in_rows and words and words[0].isdigit():
            single = [*words * 3, "1", "0", "0", "0", "0", "0"]
            rows.append([float(word) for word in (words if len(words) > 1 else single)])
        elif rows and words:
            break
    numbers = np.array(rows)
    return numbers[:, :3].astype(int), numbers[:, 3:6], numbers[:, 6:9], scale


def _split_at_seams(text: str) -> tuple[Integers, Doubles, Integers]:
    """Return quads (F, 4), texture coordinates (V, 2), and the vertex in the file of each (V,)."""
    _, uv, faces, _ = read_obj(text)
    pairs, quads = np.unique(faces.reshape(-1, 2), axis=0, return_inverse=True)
    places = uv[pairs[:, 1]]
    return quads.reshape(-1, 4), np.stack([places[:, 0], 1 - places[:, 1]], axis=1), pairs[:, 0]
