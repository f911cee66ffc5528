"""Operations on the surfaces of the built-in heads: Catmull-Clark subdivision, normals, cuts.

E. Catmull, J. Clark, "Recursively generated B-spline surfaces on arbitrary topological meshes",
Computer-Aided Design 10(6), 1978.
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from kouxing.services.driver.head.surface import find_edges
from kouxing.shared.arrays import Doubles, Integers


def catmull_clark(quads: Integers, num_vertices: int) -> tuple[sparse.csr_array, Integers]:
    """Subdivide once.

    Returns the matrix (V + E + F, V) from the old to the new vertices (moved old vertices, edge
    points, face points), and the new quads (4 F, 4).
    """
    num_faces = len(quads)
    edges, edge_of_corner = find_edges(quads)
    num_edges = len(edges)
    face_rows = np.repeat(np.arange(num_faces), 4)
    faces = sparse.csr_array(
        (np.full(4 * num_faces, 0.25), (face_rows, quads.ravel())), (num_faces, num_vertices)
    )
    midpoints = sparse.csr_array(
        (np.full(2 * num_edges, 0.5), (np.repeat(np.arange(num_edges), 2), edges.ravel())),
        (num_edges, num_vertices),
    )
    touching = sparse.csr_array(
        (np.ones(4 * num_faces), (edge_of_corner.ravel(), face_rows)), (num_edges, num_faces)
    )
    interior = touching.sum(axis=1) == 2
    inside = sparse.diags_array(interior.astype(float))
    edge_points = inside @ (0.5 * midpoints + 0.25 * (touching @ faces)) + (
        sparse.diags_array((~interior).astype(float)) @ midpoints
    )

    # (Q + 2 R + (n - 3) P) / n for an inner vertex, (1/8, 3/4, 1/8) along a border
    around_faces = _incidence(quads.ravel(), face_rows, (num_vertices, num_faces))
    edge_rows = np.repeat(np.arange(num_edges), 2)
    around_edges = _incidence(edges.ravel(), edge_rows, (num_vertices, num_edges))
    valence = np.maximum(around_edges.sum(axis=1), 1)
    mean_faces = sparse.diags_array(1 / np.maximum(around_faces.sum(axis=1), 1)) @ around_faces
    mean_edges = sparse.diags_array(1 / valence) @ around_edges
    identity = sparse.eye_array(num_vertices)
    inner = sparse.diags_array(1 / valence) @ (
        mean_faces @ faces
        + 2 * (mean_edges @ midpoints)
        + sparse.diags_array(valence - 3.0) @ identity
    )
    border_edges = around_edges @ sparse.diags_array((~interior).astype(float))
    on_border = border_edges.sum(axis=1) == 2
    border = 0.5 * identity + 0.25 * (border_edges @ midpoints)
    vertex_points = (
        sparse.diags_array((~on_border).astype(float)) @ inner
        + sparse.diags_array(on_border.astype(float)) @ border
    )

    before = np.roll(edge_of_corner, 1, axis=1) + num_vertices
    after = edge_of_corner + num_vertices
    middle = np.broadcast_to(np.arange(num_faces)[:, None] + num_vertices + num_edges, quads.shape)
    fine = np.stack([quads, after, middle, before], axis=2).reshape(-1, 4)
    matrix = sparse.csr_array(sparse.vstack([vertex_points, edge_points, faces]))
    return matrix, fine


def smooth_strands(
    points: Doubles, quads: Integers, uv: Doubles, welds: Integers
) -> tuple[Doubles, Integers, Doubles, Integers]:
    """Subdivide a textured mesh (V, 3) once, across the seams of its texture.

    Returns points (W, 3), quads (4 F, 4), texture coordinates (W, 2), and ``welds`` (W,): the first
    vertex at the same position.
    """
    used, joined = np.unique(welds[quads], return_inverse=True)
    matrix, fine = catmull_clark(joined.reshape(-1, 4), len(used))
    corners = uv[quads]
    after = 0.5 * (corners + np.roll(corners, -1, axis=1))
    middle = np.broadcast_to(corners.mean(axis=1, keepdims=True), corners.shape)
    before = np.roll(after, 1, axis=1)
    fine_uv = np.stack([corners, after, middle, before], axis=2).reshape(-1, 2)
    table = np.column_stack([fine.ravel(), np.round(fine_uv, 6)])
    rows, vertices = np.unique(table, axis=0, return_inverse=True)
    position = rows[:, 0].astype(int)
    _, first, same = np.unique(position, return_index=True, return_inverse=True)
    return (matrix @ points[used])[position], vertices.reshape(-1, 4), rows[:, 1:], first[same]


def _incidence(rows: Integers, columns: Integers, shape: tuple[int, int]) -> sparse.csr_array:
    return sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape)


def triangles_of(quads: Integers) -> Integers:
    """Split quads (F, 4) into triangles (2 F, 3)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def used_vertices(triangles: Integers, welds: Integers) -> tuple[Integers, Integers, Integers]:
    """Return the vertices (W,) that triangles (F, 3) use, and triangles and welds (W,) of these.

    ``welds`` (V,) has the first vertex at the same position.
    """
    used, corners = np.unique(triangles, return_inverse=True)
    _, first, same = np.unique(welds[used], return_index=True, return_inverse=True)
    return used, corners.reshape(-1, 3), first[same]


def patch_sizes(quads: Integers) -> Integers:
    """Return for each quad (F, 4) the size of its connected patch, in quads."""
    corner, quad = quads.ravel(), np.repeat(np.arange(len(quads)), 4)
    incidence = _incidence(corner, quad, (quads.max() + 1, len(quads)))
    _, patch = csgraph.connected_components(incidence.T @ incidence, directed=False)
    return np.asarray(np.bincount(patch)[patch])


def vertex_normals(vertices: Doubles, triangles: Integers) -> Doubles:
    """Return the unit normals (V, 3): area-weighted means over the adjacent triangles."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], area)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return normals


def clip(
    height: Doubles, triangles: Integers, values: Doubles
) -> tuple[Doubles, Integers, Integers]:
    """Remove everything above ``height`` (V,) 0; ``values`` (V, D) are interpolated at the cut.

    Returns values (W, D) of old and new vertices, triangles (G, 3), and the edges (E, 2) of the cut
    in the direction of their triangles.
    """
    above = height[triangles] > 0
    remaining = triangles[~above.any(axis=1)].tolist()
    rows = list(values)
    new_rows: dict[tuple[int, int], int] = {}
    rim = []

    def cut(i: int, j: int) -> int:
        key = (min(i, j), max(i, j))
        if key not in new_rows:
            fraction = height[i] / (height[i] - height[j])
            new_rows[key] = len(rows)
            rows.append(values[i] + fraction * (values[j] - values[i]))
        return new_rows[key]

    for corners, high in zip(triangles, above, strict=True):
        if not high.any() or high.all():
            continue
        # rotate the corners so that the single corner on its side of the cut comes first
        alone = int(np.argmax(high)) if high.sum() == 1 else int(np.argmin(high))
        a, b, c = (int(vertex) for vertex in np.roll(corners, -alone))
        p, q = cut(a, b), cut(a, c)
        if high.sum() == 1:
            remaining += [[p, b, c], [p, c, q]]
            rim.append([q, p])
        else:
            remaining.append([a, p, q])
            rim.append([p, q])
    return np.array(rows), np.array(remaining), np.array(rim)
