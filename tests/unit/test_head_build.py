"""The geometry that builds the head: subdivision, and parts fitted to a head."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.shared.errors import UserError
from kouxing.training.heads import fitted_mesh, parts, subdivision

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


OBJ = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
f 1/1 2/2 3/3 4/4
f 2/2 3/1 4/4
"""
MHCLO = """x_scale 0 1 2.0
y_scale 0 2 2.0
z_scale 0 3 2.0
verts 0
material any.mhmat
0
1
2
0 1 2 0.5 0.25 0.25 0.5 0.0 -0.25
"""


def test_a_fitted_part_follows_its_head(tmp_path: Path) -> None:
    (tmp_path / "part.obj").write_text(OBJ, encoding="utf-8")
    (tmp_path / "part.mhclo").write_text(MHCLO, encoding="utf-8")
    part = fitted_mesh.read(tmp_path, "part")
    head = np.array([[0.0, 0, 0], [4, 0, 0], [0, 2, 0], [0, 0, 1]])
    corners = part.fit(head)
    assert len(corners) == 5  # the third vertex is split by the seam of the texture
    assert len(np.unique(part.welds)) == 4
    weighted = [1.0 + 0.5 * 4 / 2, 0.5, -0.25 * 1 / 2]
    np.testing.assert_allclose(corners[np.argmin(part.weights[:, 0])], weighted)
    shift = np.zeros((4, 3))
    shift[2] = [0, 1, 0]
    moved = part.transfer(shift)[:, 1]
    np.testing.assert_allclose(sorted(moved), [0, 0, 0.25, 1, 1])
    triangle = part.keep_triangles(np.array([False, True, False]))
    assert len(triangle.triangles) == 1
    assert len(triangle.fit(head)) == 3


def test_a_head_has_16_bit_numbers_of_vertices(tmp_path: Path) -> None:
    many = np.zeros((65_536, 3))
    geometry = parts.Geometry(many, np.zeros((1, 3), int), many[:, :2], many)
    skin = parts.HeadPiece("skin", geometry, "skin", 0.5, many[:, 0])
    nothing: Any = None
    with pytest.raises(UserError, match="the head has 65536 vertices; use at most 65535"):
        parts.write(tmp_path / "my.npz", [skin], {}, nothing, nothing, {}, cel=False)
