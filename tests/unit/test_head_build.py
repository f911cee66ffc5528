"""The geometry that builds the head: subdivision, zones, interpolation, clipping."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.head import surface
from kouxing.training.heads import subdivision

CUBE = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
     [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float
)  # fmt: skip
CUBE_QUADS = np.array(
    [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
)


def sheet(rows: int, columns: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Make a flat grid of unit squares."""
    y, x = np.mgrid[:rows, :columns]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.stack([x, y, 0 * x], axis=2).reshape(-1, 3).astype(float), quads


def test_catmull_clark_of_a_cube() -> None:
    matrix, quads = subdivision.catmull_clark(CUBE_QUADS, 8)
    fine = matrix @ CUBE
    assert len(quads) == 24
    assert len(fine) == 8 + 12 + 6
    np.testing.assert_allclose(matrix.sum(axis=1), 1)
    # textbook: a corner of the cube moves to 5/9, an edge point lies at 3/4, a face point stays
    np.testing.assert_allclose(np.abs(fine[:8]), 5 / 9)
    np.testing.assert_allclose(sorted(np.abs(fine[8])), [0, 0.75, 0.75])
    np.testing.assert_allclose(sorted(np.abs(fine[-1])), [0, 0, 1])


def test_zone_is_a_raised_cosine() -> None:
    vertices, quads = sheet(3, 9)
    row = np.arange(9)
    zone = surface.Geodesics(vertices, quads).zone(row[:1] + 9, row[-1:] + 9)
    np.testing.assert_allclose(zone[9:18], 0.5 + 0.5 * np.cos(np.pi * row / 8), atol=1e-12)
