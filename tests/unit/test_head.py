"""The head: every feature point lands where its FAP says; broken assets are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.driver.head import ASSETS, DEFAULT_HEAD, Detail, Head, neutral_faps
from shared.errors import UserError
from shared.faps import FAPS, NUM_FAPS, Fap

pytestmark = pytest.mark.unit

AXES = {
    "down": (1, -1.0),
    "up": (1, 1.0),
    "left": (0, 1.0),
    "right": (0, -1.0),
    "forward": (2, 1.0),
}
DISPLACING = [fap for fap in FAPS if fap.direction in AXES and fap.fapu != "AU"]
LIP_POINTS = [f"2.{n}" for n in range(2, 10)] + [f"8.{n}" for n in range(1, 9)]


@pytest.fixture(scope="module", params=["fine", "coarse"])
def head(request: pytest.FixtureRequest) -> Head:
    detail: Detail = request.param
    return Head.load(detail=detail)


def moved(head: Head, number: int, value: float) -> NDArray[np.float32]:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[number - 1] = value
    return head.deform(faps) - head.vertices


@pytest.mark.parametrize("fap", DISPLACING, ids=lambda fap: fap.name)
def test_feature_points_land(head: Head, fap: Fap) -> None:
    axis, sign = AXES[fap.direction]
    for value in (300.0, -120.0):
        wanted = sign * value * head.fapu[fap.fapu] / 1024
        shift = moved(head, fap.number, value)
        for point in fap.feature_points:
            assert shift[head.feature_points[point], axis] == pytest.approx(wanted, rel=0.05)


def test_no_fap_moves_a_lip_point_of_another_along_its_axis(head: Head) -> None:
    lips = {p: fap for fap in DISPLACING for p in fap.feature_points if p in LIP_POINTS}
    vertical = [f for f in DISPLACING if AXES[f.direction][0] == 1 and f.number != 18]
    assert lips
    for fap in vertical:
        travel = 300 * head.fapu[fap.fapu] / 1024
        shift = moved(head, fap.number, 300.0)
        for point in LIP_POINTS:
            if point not in fap.feature_points:
                assert abs(shift[head.feature_points[point], 1]) < 0.05 * travel, (fap.name, point)


def test_open_jaw_does_not_part_the_lips(head: Head) -> None:
    shift = moved(head, 3, 500.0)
    inner = [head.feature_points[f"2.{n}"] for n in range(2, 10)]
    assert np.abs(shift[inner, 1]).max() < 0.05 * 500 * head.fapu["MNS"] / 1024


def test_deformation_is_linear(head: Head) -> None:
    rng = np.random.default_rng(1)
    faps = rng.normal(0, 80, NUM_FAPS).astype(np.float32)
    faps[[22, 23, 24, 25, 47, 48, 49]] = 0  # the rotations
    once, twice = head.deform(faps) - head.vertices, head.deform(2 * faps) - head.vertices
    np.testing.assert_allclose(2 * once, twice, atol=2e-6)


def test_neutral_faps_leave_the_face_alone(head: Head) -> None:
    np.testing.assert_array_equal(head.deform(neutral_faps()), head.vertices)


def test_both_levels_move_alike() -> None:
    fine, coarse = Head.load(detail="fine"), Head.load(detail="coarse")
    assert len(coarse.vertices) < 0.6 * len(fine.vertices)
    faps = neutral_faps(open_jaw=300, raise_b_midlip=-300, stretch_l_cornerlip=-100)
    for point, vertex in fine.feature_points.items():
        np.testing.assert_allclose(
            fine.deform(faps)[vertex], coarse.deform(faps)[coarse.feature_points[point]], atol=1e-6
        )


@pytest.mark.parametrize(
    ("name", "point", "axis", "sign"),
    [
        ("yaw_l_eyeball", "3.5", 0, 1),  # to the subject's left
        ("yaw_r_eyeball", "3.6", 0, 1),
        ("pitch_l_eyeball", "3.5", 1, -1),  # down
        ("pitch_r_eyeball", "3.6", 1, -1),
        ("head_yaw", "9.3", 0, 1),
        ("head_pitch", "9.3", 1, -1),
        ("head_roll", "11.4", 0, -1),  # the top tilts to the subject's right
    ],
)
def test_rotations(head: Head, name: str, point: str, axis: int, sign: int) -> None:
    vertices = head.deform(neutral_faps(**{name: 10_000.0}))  # 0.1 rad
    vertex = head.feature_points[point]
    assert sign * (vertices[vertex] - head.vertices[vertex])[axis] > 0.0005
    eye = int(name.split("_")[1] == "r")
    pivot = head.eye_centres[eye] if "eyeball" in name else np.zeros(3)
    np.testing.assert_allclose(
        np.linalg.norm(vertices[vertex] - pivot),
        np.linalg.norm(head.vertices[vertex] - pivot),
        rtol=1e-4,
    )


def test_shoulders_stay_when_the_head_turns(head: Head) -> None:
    shift = head.deform(neutral_faps(head_yaw=30_000.0)) - head.vertices
    assert np.abs(shift[head.part("garment").vertices]).max() == 0
    assert np.abs(shift[head.part("hair").vertices]).max() > 0.01


def test_normals_are_unit_and_follow(head: Head) -> None:
    faps = neutral_faps(open_jaw=300, raise_b_midlip=-400, head_yaw=20_000)
    vertices, normals = head.pose(faps)
    np.testing.assert_allclose(vertices, head.deform(faps), atol=1e-7)
    # where the neck bends, normals are blended like the vertices and shorten a little
    assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 0.03


def test_faps_of_a_wrong_shape_are_refused(head: Head) -> None:
    with pytest.raises(ValueError, match=r"\(68,\)"):
        head.deform(np.zeros(66, np.float32))


def test_unknown_fap_name() -> None:
    with pytest.raises(UserError, match="open_jar"):
        neutral_faps(open_jar=1.0)


def test_unknown_head() -> None:
    with pytest.raises(UserError, match=DEFAULT_HEAD):
        Head.load("nobody")


@pytest.mark.parametrize("damage", ["cut", "text", "format", "missing", "index"])
def test_broken_asset(tmp_path: Path, damage: str) -> None:
    good = ASSETS / f"{DEFAULT_HEAD}.npz"
    broken = tmp_path / "broken.npz"
    if damage == "cut":
        broken.write_bytes(good.read_bytes()[:5000])
    elif damage == "text":
        broken.write_text("no head")
    else:
        with np.load(good) as asset:
            arrays = {key: asset[key] for key in asset.files}
        if damage == "format":
            arrays["format"] = np.array("kouxing head 99")
        elif damage == "missing":
            del arrays["uv"]
        else:
            arrays["field_vertices"] = arrays["field_vertices"] + np.uint16(40_000)
        np.savez(broken, allow_pickle=False, **arrays)
    with pytest.raises(UserError, match="broken"):
        Head.load(broken)
