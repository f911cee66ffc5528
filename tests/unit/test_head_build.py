"""The geometry that builds the head: subdivision, zones, interpolation, clipping."""

import numpy as np

from kouxing.training.heads import subdivision

CUBE = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1],
     [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], float
)  # fmt: skip
CUBE_QUADS = np.array(
    [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
)


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
