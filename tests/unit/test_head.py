"""Heads move their feature points as defined; damaged files are rejected."""

from pathlib import Path

import numpy as np
import pytest

from kouxing.services.driver.head.head import ASSETS, Detail, Head
from kouxing.services.heads import DEFAULT_HEAD
from kouxing.shared.errors import UserError
from kouxing.shared.face.high_level_faps import expression_faps, viseme_faps
from tests import heads
from tests.heads import neutral_faps

LEVELS = [("woman", "coarse"), *((name, "fine") for name in heads.NAMES)]


@pytest.fixture(scope="module", params=LEVELS, ids="-".join)
def head(request: pytest.FixtureRequest) -> Head:
    name: str = request.param[0]
    detail: Detail = request.param[1]
    return heads.load(name, detail)


def test_feature_points_move_as_defined(head: Head) -> None:
    shown = set()
    for fap in heads.DISPLACING_FAPS:
        for value in (300.0, -120.0):
            axis, expected = heads.travel_m(head, fap, value)
            shift = head.deform(heads.single_fap(fap.number, value)) - head.vertices
            for point in fap.feature_points:
                shown.add(point)
                moved = shift[head.feature_points[point], axis]
                assert moved == pytest.approx(expected, rel=0.05), (fap.name, point)
    assert len(shown) > 40


@pytest.mark.parametrize(
    ("name", "point", "about", "axis", "sign"),
    [
        ("yaw_l_eyeball", "3.5", 1, 0, 1),  # to the subject's left
        ("yaw_r_eyeball", "3.6", 1, 0, 1),
        ("pitch_l_eyeball", "3.5", 0, 1, -1),  # down
        ("pitch_r_eyeball", "3.6", 0, 1, -1),
        ("head_yaw", "9.3", 1, 0, 1),
        ("head_pitch", "9.3", 0, 1, -1),
        ("head_roll", "11.4", 2, 0, -1),  # the top tilts to the subject's right
    ],
)
def test_rotates_eyes_and_head_in_the_direction_of_the_fap(
    head: Head, name: str, point: str, about: int, axis: int, sign: int
) -> None:
    vertices = head.deform(neutral_faps(**{name: 10_000.0}))  # 0.1 rad
    vertex = head.feature_points[point]
    eye = int(name.split("_")[1] == "r")
    pivot = head.eye_centers[eye] if "eyeball" in name else np.zeros(3)
    before, after = (np.delete(v[vertex] - pivot, about) for v in (head.vertices, vertices))
    assert sign * (vertices[vertex] - head.vertices[vertex])[axis] > 0.0005
    turned = np.arccos(before @ after / np.linalg.norm(before) / np.linalg.norm(after))
    assert turned == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("damage", ["cut", "format", "uv", "index", "huge"])
def test_rejects_a_damaged_file(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = ASSETS / f"{DEFAULT_HEAD}.npz"
    broken = tmp_path / "broken.npz"
    with np.load(good) as asset:
        arrays = {key: asset[key] for key in asset.files}
    if damage == "format":
        arrays["format"] = np.array("kouxing head 99")
    elif damage == "uv":
        del arrays["uv"]
    elif damage == "index":
        arrays["field_vertices"] = arrays["field_vertices"] + np.uint16(40_000)
    elif damage == "huge":
        monkeypatch.setattr("kouxing.services.driver.head.head.MAX_BYTES", 100_000)
    np.savez(broken, allow_pickle=False, **arrays)
    if damage == "cut":
        broken.write_bytes(good.read_bytes()[:5000])
    with pytest.raises(UserError, match="broken"):
        Head.load(broken)


# --- FAP 1 and FAP 2 ---


def test_visemes_and_expressions_move_the_face() -> None:
    head = heads.load("woman", "coarse")
    lower = head.feature_points["2.3"]
    assert head.deform(viseme_faps(10, 0, 63))[lower, 1] < head.vertices[lower, 1] - 0.008
    corner = head.feature_points["8.3"]
    assert head.deform(expression_faps(1, 63))[corner, 1] > head.vertices[corner, 1] + 0.004
