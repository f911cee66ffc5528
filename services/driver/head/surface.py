"""Geodesic distances, zones of influence and smooth fields on surfaces."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

from kouxing.shared.arrays import Doubles, Integers, Mask


def find_edges(quads: Integers) -> tuple[Integers, Integers]:
    """Return the undirected edges (E, 2) of quads (F, 4) or triangles (F, 3).

    The smaller vertex number comes first. The second result is the number of the edge after each
    corner, in the shape of ``quads``.
    """
    pairs = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, edge_index = np.unique(np.sort(pairs, axis=1), axis=0, return_inverse=True)
    return edges, edge_index.reshape(quads.shape)


class Geodesics:
    """Shortest paths along the edges of a surface of triangles or quads, and quad diagonals."""

    def __init__(self, vertices: Doubles, faces: Integers) -> None:
        pairs, _ = find_edges(faces)
        if faces.shape[1] == 4:
            pairs = np.concatenate([pairs, faces[:, [0, 2]], faces[:, [1, 3]]])
        length = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        self._graph = sparse.csr_array(
            (np.maximum(length, 1e-9), (pairs[:, 0], pairs[:, 1])), (len(vertices),) * 2
        )

    def distance(self, sources: Integers) -> Doubles:
        """Return the distance (V,) to the nearest source; inf where no source is connected."""
        distance: Doubles = csgraph.dijkstra(
            self._graph, directed=False, indices=sources, min_only=True
        )
        return distance

    def zone(self, moving: Integers, fixed: Integers) -> Doubles:
        """Return weights (V,): 1 on ``moving``, 0 on ``fixed``, a raised cosine in between.

        ``w = 1/2 - 1/2 cos(pi dF / (dF + dM))`` with the geodesic distances ``dM`` and ``dF`` to
        the two sets, as in Li 2011, section 2.1. Distances along the surface keep the upper lip in
        place when the chin, which is close in space, moves.
        """
        to_moving, to_fixed = self.distance(moving), self.distance(fixed)
        reached = np.isfinite(to_moving)
        fraction = reached.astype(float)
        both = reached & np.isfinite(to_fixed)
        fraction[both] = to_fixed[both] / np.maximum(to_fixed[both] + to_moving[both], 1e-12)
        return 0.5 - 0.5 * np.cos(np.pi * fraction)


def smoothest_fields(
    vertices: Doubles, triangles: Integers, points: Integers | list[Integers], fixed: Mask
) -> Doubles:
    """Return the smoothest fields (V, P) with value 1 at ``points[p]`` and 0 at the other points.

    They minimize the squared Laplacian (cotangent weights) integrated over the surface. ``points``
    are vertices or groups of vertices that move together. Fields are also 0 at vertices that are
    ``fixed`` (V,) and not among the points.
    """
    num_vertices = len(vertices)
    laplacian, area = _laplacian(vertices, triangles)
    energy = (laplacian @ sparse.diags_array(1 / area) @ laplacian).tocsc()
    is_free = np.ones(num_vertices, dtype=bool)
    is_free[fixed] = False
    fields = np.zeros((num_vertices, len(points)))
    for column, group in enumerate(points):
        is_free[group] = False
        fields[group, column] = 1.0
    free = np.flatnonzero(is_free)
    right = -(energy[free] @ fields)
    solve = linalg.splu(energy[free][:, free].tocsc())
    fields[free] = solve.solve(right)
    return fields


def _laplacian(vertices: Doubles, triangles: Integers) -> tuple[sparse.csr_array, Doubles]:
    rows, columns, weights = [], [], []
    area = np.zeros(len(vertices))
    for corner in range(3):
        i, j, k = (triangles[:, (corner + step) % 3] for step in range(3))
        a, b = vertices[j] - vertices[i], vertices[k] - vertices[i]
        double_area = np.maximum(np.linalg.norm(np.cross(a, b), axis=1), 1e-9)
        cotangent = np.clip((a * b).sum(axis=1) / double_area, -5, 5) / 2
        rows += [j, k]
        columns += [k, j]
        weights += [cotangent, cotangent]
        np.add.at(area, i, double_area / 6)
    shape = (len(vertices),) * 2
    adjacency = sparse.csr_array(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape
    )
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return sparse.csr_array(sparse.diags_array(degree) - adjacency), np.maximum(area, 1e-8)
