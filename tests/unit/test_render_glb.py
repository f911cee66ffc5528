"""The exported GLB is consistent, small and complete."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS
from kouxing.shared.face.shapes import ARKIT
from tests import heads

pytestmark = pytest.mark.unit

SIZES = {5121: 1, 5123: 2, 5125: 4, 5126: 4}
COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("glb") / "head.glb"
    export_glb(heads.load("woman"), path)
    return path


@pytest.fixture(scope="module")
def document(glb: Path) -> dict[str, Any]:
    data = glb.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    read: dict[str, Any] = json.loads(data[20 : 20 + size])
    binary, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    read["binary"] = data[28 + size :]
    assert read["buffers"][0]["byteLength"] <= binary == len(read["binary"])
    return read


def test_opaque_parts_have_coarse_triangles(document: dict[str, Any]) -> None:
    coarse = heads.load("woman", "coarse")
    of_mesh = {mesh["name"]: mesh["extras"].get("coarse") for mesh in document["meshes"]}
    assert {name for name, index in of_mesh.items() if index is not None} == {"skin", "tongue"}
    for name in ("skin", "tongue"):
        part = coarse.part(name)
        triangles = coarse.triangles[part.triangles] - part.vertices.start
        view = document["bufferViews"][document["accessors"][of_mesh[name]]["bufferView"]]
        stored = np.frombuffer(document["binary"], np.uint16, triangles.size, view["byteOffset"])
        assert np.array_equal(stored, triangles.ravel())


def test_accessors_match_their_views(document: dict[str, Any]) -> None:
    views = document["bufferViews"]
    for view in views:
        assert view["byteOffset"] + view["byteLength"] <= len(document["binary"])
        assert view["byteOffset"] % 4 == 0
    for accessor in document["accessors"]:
        item = SIZES[accessor["componentType"]] * COMPONENTS[accessor["type"]]
        if "bufferView" in accessor:
            assert accessor["count"] * item == views[accessor["bufferView"]]["byteLength"]
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            values = views[sparse["values"]["bufferView"]]
            assert sparse["count"] * item == values["byteLength"]
            at = views[sparse["indices"]["bufferView"]]
            rows = np.frombuffer(
                document["binary"], np.uint16, sparse["count"], at["byteOffset"]
            ).astype(int)
            assert (np.diff(rows) > 0).all()
            assert rows[-1] < accessor["count"]


def test_every_fap_is_a_target_or_a_rotation(document: dict[str, Any]) -> None:
    described = {fap["name"]: fap for fap in document["scenes"][0]["extras"]["kouxing"]["faps"]}
    assert list(described) == [fap.name for fap in FAPS[2:]]
    targets = {
        name
        for mesh in document["meshes"]
        for name in mesh.get("extras", {}).get("targetNames", [])
    }
    turned = {name for name, fap in described.items() if "rotation" in fap}
    assert (targets | turned) - set(ARKIT.names) == set(described)
    names = {node["name"] for node in document["nodes"]}
    assert {described[name]["rotation"]["node"] for name in turned} <= names


def moved(document: dict[str, Any], mesh_name: str, target: str) -> dict[int, Any]:
    """Return displacements by vertex number."""
    mesh = next(mesh for mesh in document["meshes"] if mesh["name"] == mesh_name)
    row = mesh["extras"]["targetNames"].index(target)
    accessor = document["accessors"][mesh["primitives"][0]["targets"][row]["POSITION"]]
    sparse, views = accessor["sparse"], document["bufferViews"]
    binary, count = document["binary"], sparse["count"]
    rows = np.frombuffer(
        binary, np.uint16, count, views[sparse["indices"]["bufferView"]]["byteOffset"]
    )
    values = np.frombuffer(
        binary, np.float32, 3 * count, views[sparse["values"]["bufferView"]]["byteOffset"]
    )
    return dict(zip(rows.tolist(), values.reshape(-1, 3), strict=True))


def test_every_arkit_shape_is_a_target(document: dict[str, Any]) -> None:
    targets = {
        name
        for mesh in document["meshes"]
        for name in mesh.get("extras", {}).get("targetNames", [])
    }
    assert set(ARKIT.names) <= targets
    described = document["scenes"][0]["extras"]["kouxing"]["arkit"]
    assert [shape["name"] for shape in described] == list(ARKIT.names)
    assert described[ARKIT.names.index("jawOpen")]["faps"]["open_jaw"] > 0


def test_arkit_shapes_move_all_parts(document: dict[str, Any]) -> None:
    head = heads.load("woman")
    for shape, part, point in (
        ("jawOpen", "skin", "2.3"),
        ("jawOpen", "teeth_lower", "9.11"),
        ("tongueOut", "tongue", "6.1"),
        ("eyeLookUpLeft", "eye_left", "3.5"),
    ):
        vertex = head.feature_points[point]
        faps = ARKIT.basis[ARKIT.names.index(shape)]
        wanted = (head.deform(faps) - head.vertices)[vertex]
        shift = moved(document, part, shape)[vertex - head.part(part).vertices.start]
        np.testing.assert_allclose(shift, wanted, atol=1e-5)


def test_unwritable_path(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot write"):
        export_glb(heads.load("woman", "coarse"), tmp_path / "no" / "head.glb")
    with pytest.raises(UserError, match=r"ends in \.glb"):
        export_glb(heads.load("woman", "coarse"), tmp_path / "head.png")


def read(document: dict[str, Any], binary: bytes, accessor: int) -> np.ndarray:
    """Return the floats of an accessor, flat."""
    view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
    return np.frombuffer(binary, np.float32, view["byteLength"] // 4, view["byteOffset"])


@pytest.mark.parametrize("as_arkit", [False, True])
def test_animation_moves_the_head_like_its_faps(tmp_path: Path, *, as_arkit: bool) -> None:
    head = heads.load("woman", "coarse")
    faps = np.zeros((3, 68), np.float32)
    faps[1] = 0.5 * ARKIT.basis[ARKIT.names.index("jawOpen")]
    faps[2, 48] = 0.1 / 1e-5  # the head rotates by 0.1 rad
    path = tmp_path / "speaks.glb"
    export_glb(head, path, [(0.02 * k, row) for k, row in enumerate(faps)], as_arkit=as_arkit)
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    (animation,) = document["animations"]
    curves = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        target = channel["target"]
        name = document["nodes"][target["node"]]["name"]
        curves[name, target["path"]] = read(document, data[28 + size :], sampler["output"])
        times_s = read(document, data[28 + size :], sampler["input"])
        np.testing.assert_allclose(times_s, [0.0, 0.02, 0.04])
    np.testing.assert_allclose(
        curves["head", "rotation"].reshape(3, 4)[2], [0, np.sin(0.05), 0, np.cos(0.05)], atol=1e-6
    )
    (skin,) = (part for part in head.parts if part.name == "skin")
    targets = next(m for m in document["meshes"] if m["name"] == "skin")["extras"]["targetNames"]
    weights = curves["skin", "weights"].reshape(3, len(targets))
    assert not weights[0].any()
    moved = np.zeros((skin.vertices.stop - skin.vertices.start, 3))
    fields = head.basis[3 * skin.vertices.start : 3 * skin.vertices.stop].T.toarray()
    for name, weight in zip(targets, weights[1], strict=True):
        if weight and as_arkit:
            moved += weight * (ARKIT.basis[ARKIT.names.index(name)] @ fields).reshape(-1, 3)
        elif weight:
            fap = next(fap for fap in FAPS if fap.name == name)
            moved += 1024 * weight * fields[fap.number - 1].reshape(-1, 3)
    expected = (faps[1] @ fields).reshape(-1, 3)
    error_m = np.abs(moved - expected).max()
    assert error_m < (0.1 if as_arkit else 0.01) * np.abs(expected).max()
