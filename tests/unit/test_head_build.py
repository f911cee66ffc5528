"""The geometry that builds the head: subdivision, zones, interpolation, clipping."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver.head import surface
from kouxing.training.heads import people, subdivision, zones

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


def test_the_smoothest_field_is_1_at_its_points() -> None:
    vertices, quads = sheet(9, 9)
    skin = zones.subdivided(vertices, quads)
    points = skin.number[[30, 33, 50]]
    border = np.flatnonzero(
        (skin.vertices[:, :2] < 0.3).any(axis=1) | (skin.vertices[:, :2] > 7.7).any(axis=1)
    )
    fields = zones.smoothest(skin, points, border)
    np.testing.assert_allclose(fields[points], np.eye(3), atol=1e-9)
    assert np.abs(fields[border]).max() == 0
    assert np.abs(fields).max() < 1.5


def ball() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the center of a skull and points of its skin."""
    away = np.random.default_rng(1).standard_normal((1500, 3))
    middle = np.array([0.0, 5.93, 0.42])
    return middle, middle + 0.8 * away / np.linalg.norm(away, axis=1, keepdims=True)


@pytest.mark.parametrize("name", people.PEOPLE)
def test_hair_faces_outward(name: str) -> None:
    """Occlusion is judged, and light is worked out, along the normals."""
    middle, scalp = ball()
    for part in people.PEOPLE[name].hair.parts(scalp).values():
        a, b, c = (part.vertices[part.triangles[:, corner]] for corner in range(3))
        centre = (a + b + c) / 3
        axis = np.where(centre[:, 1:2] > middle[1], middle, centre * [0, 1, 0] + [0, 0, 0.2])
        assert ((np.cross(b - a, c - a) * (centre - axis)).sum(axis=1) > 0).mean() > 0.8


def test_clip_cuts_at_height_zero() -> None:
    vertices, quads = sheet(3, 3)
    triangles = subdivision.triangles_of(quads)
    cut, kept, rim = subdivision.clip(vertices[:, 1] - 1.25, triangles, vertices)
    a, b, c = (cut[kept[:, corner]] for corner in range(3))
    doubled = np.cross(b - a, c - a)[:, 2]
    assert (doubled > 0).all()  # no triangle is turned over
    assert doubled.sum() / 2 == pytest.approx(2 * 1.25)
    np.testing.assert_allclose(cut[rim][..., 1], 1.25)
    assert np.abs(np.diff(cut[rim][..., 0], axis=1)).sum() == pytest.approx(2)
