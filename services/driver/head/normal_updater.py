"""Computes the normals of a surface whose vertices move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from kouxing.shared.arrays import Floats, Integers


@dataclass(frozen=True, slots=True)
class NormalUpdater:
    """Updates the normals of a deformable surface where its vertices move."""

    rest: Floats  # (V, 3), normals of the neutral face
    triangles: NDArray[np.uint32]  # triangles that the basis deforms
    vertices: Integers  # vertices whose normals change
    incidence: sparse.csr_array  # (vertices, triangles)

    @classmethod
    def of(
        cls,
        vertices: Floats,
        triangles: NDArray[np.uint32],
        basis: sparse.csr_array,
        welds: Integers | None = None,
    ) -> NormalUpdater:
        """Find the vertices of a ``Head`` whose normals change.

        ``welds`` (V,) is the vertex that shares its normal with each vertex, because several
        vertices have one position at texture seams. By default no normals are shared.
        """
        same = np.arange(len(vertices)) if welds is None else welds
        welded = same[triangles.astype(np.int64)]
        moves = np.zeros(len(vertices), dtype=bool)
        moves[same[np.unique(basis.nonzero()[0] // 3)]] = True
        turns = np.zeros(len(vertices), dtype=bool)
        turns[welded[moves[welded].any(axis=1)]] = True
        around = turns[welded].any(axis=1)  # a normal depends on all triangles at its vertex
        soft = np.flatnonzero(turns[same])
        return cls(
            rest=_normals(vertices, triangles, welded)[same],
            triangles=triangles[around],
            vertices=soft,
            incidence=_incidence(welded[around], len(vertices))[same[soft]],
        )

    def normals(self, vertices: Floats) -> Floats:
        """Return the normals (V, 3) of deformed vertices (V, 3)."""
        normals = self.rest.copy()
        a, b, c = vertices[self.triangles.T]
        soft = self.incidence @ _cross(b - a, c - a)
        length = np.sqrt(np.einsum("ij,ij->i", soft, soft))[:, None]
        # keep the neutral normal where triangles have no area
        normals[self.vertices] = np.where(
            length > 1e-14, soft / np.maximum(length, 1e-14), normals[self.vertices]
        )
        return normals


def _cross(a: Floats, b: Floats) -> Floats:
    """Return cross products by columns. numpy's own function takes several times as long."""
    out = np.empty_like(a)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def _incidence(triangles: NDArray[Any], num_vertices: int) -> sparse.csr_array:
    rows = triangles.T.ravel()
    columns = np.tile(np.arange(len(triangles)), 3)
    return sparse.csr_array(
        (np.ones(len(rows), np.float32), (rows, columns)), (num_vertices, len(triangles))
    )


def _normals(vertices: Floats, triangles: NDArray[np.uint32], welded: Integers) -> Floats:
    a, b, c = vertices[triangles.T]
    normals = _incidence(welded, len(vertices)) @ _cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    ahead = np.array([0.0, 0.0, 1.0])  # for vertices without triangle area
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-20), ahead).astype(np.float32)
