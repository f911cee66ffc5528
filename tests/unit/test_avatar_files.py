"""Avatars as other programs write them are heads: VRM, compression, axes, places of names."""

import base64
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import DracoPy
import meshopt
import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver.head import glb_file
from kouxing.services.driver.head.glb_head import read_glb
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.scene import load_head
from kouxing.shared.errors import UserError
from kouxing.shared.face.shapes import ARKIT, OCULUS, VRM
from tests.glb_writer import (
    TRANSFORMS,
    add_skeleton,
    add_view,
    add_vrm,
    edit,
    read_chunks,
    wrap_scene,
    write_glb,
)
from tests.heads import neutral_faps
from tests.meshes import ORIGINAL, meshes, shape_error

JAW, AA = (shapes.basis[shapes.names.index(n)] for shapes, n in ((ARKIT, "jawOpen"), (VRM, "aa")))
SHAPES = dict(zip(ARKIT.names, ARKIT.basis, strict=True))


def content(
    document: dict[str, Any], binary: bytearray, accessor: int, kind: str
) -> tuple[slice, NDArray[Any]]:
    """Return the place of an accessor in the binary chunk, and its rows of three numbers."""
    view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
    place = slice(view["byteOffset"], view["byteOffset"] + view["byteLength"])
    return place, np.frombuffer(bytes(binary[place]), kind).reshape(-1, 3)


def names_in_primitives(document: dict[str, Any], _binary: bytearray) -> None:
    for mesh in document["meshes"]:
        mesh["primitives"][0]["extras"] = mesh.pop("extras", {})


def names_in_accessors(document: dict[str, Any], _binary: bytearray) -> None:
    for mesh in document["meshes"]:
        targets = mesh["primitives"][0].get("targets", [])
        for target, name in zip(
            targets, mesh.pop("extras", {}).get("targetNames", []), strict=True
        ):
            document["accessors"][target["POSITION"]]["name"] = name


def transform(kind: str, document: dict[str, Any], _binary: bytearray) -> None:
    wrap_scene(document, **TRANSFORMS[kind])


def no_scenes(document: dict[str, Any], _binary: bytearray) -> None:
    wrap_scene(document, **TRANSFORMS["sideways"])
    del document["scene"], document["scenes"]


def one_eye_mirrored(document: dict[str, Any], binary: bytearray) -> None:
    node = next(node for node in document["nodes"] if node["name"] == "eye_right")
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    place, points = content(document, binary, primitive["attributes"]["POSITION"], "<f4")
    binary[place] = (points * np.array([-1, 1, 1], "<f4")).tobytes()
    place, corners = content(document, binary, primitive["indices"], "<u4")
    binary[place] = corners[:, ::-1].tobytes()
    node["scale"] = [-1, 1, 1]


def lights(document: dict[str, Any], _binary: bytearray) -> None:
    document["extensionsRequired"] = ["KHR_lights_punctual"]


def texture_of_an_extension(document: dict[str, Any], _binary: bytearray) -> None:
    for texture in document["textures"]:
        del texture["source"]


def texture_of_an_unknown_extension(document: dict[str, Any], _binary: bytearray) -> None:
    document["images"].append({"bufferView": 0, "mimeType": "image/ktx2"})
    other = {"source": len(document["images"]) - 1}
    for texture in document["textures"]:
        texture["extensions"] = {"KHR_texture_basisu": other}


def several_scenes(document: dict[str, Any], _binary: bytearray) -> None:
    document["scenes"].insert(0, {"nodes": [len(document["nodes"])]})
    document["nodes"].append({"name": "empty"})
    document["scene"] = 1


def nothing_to_draw(document: dict[str, Any], _binary: bytearray) -> None:
    document["meshes"][0]["primitives"].append({"attributes": {}})


def sparse_shapes(document: dict[str, Any], binary: bytearray) -> None:
    """Store only the vertices that a shape moves."""
    for mesh in document["meshes"]:
        for target in mesh["primitives"][0].get("targets", []):
            _, shifts = content(document, binary, target["POSITION"], "<f4")
            moved = np.flatnonzero(shifts.any(axis=1))
            indices, values = (
                {"bufferView": add_view(document, binary, array.tobytes())}
                for array in (moved.astype("<u4"), shifts[moved])
            )
            accessor = document["accessors"][target["POSITION"]]
            del accessor["bufferView"]
            accessor["sparse"] = {
                "count": len(moved),
                "indices": indices | {"componentType": 5125},
                "values": values,
            }


def null_binds(document: dict[str, Any], _binary: bytearray) -> None:
    groups = [{"name": "happy", "presetName": "joy", "binds": None}]
    document["extensions"] = {"VRM": {"blendShapeMaster": {"blendShapeGroups": groups}}}


def data_uri(document: dict[str, Any], binary: bytearray) -> None:
    document["buffers"].append(
        {
            "byteLength": len(binary),
            "uri": "data:application/octet-stream;base64," + base64.b64encode(binary).decode(),
        }
    )
    for view in document["bufferViews"]:
        view["buffer"] = 1


def draco(document: dict[str, Any], binary: bytearray, **options: Any) -> None:
    """Compress the first mesh, the skin, and remove its uncompressed positions."""
    primitive = document["meshes"][0]["primitives"][0]
    arrays = {}
    for name, number, kind in (
        ("points", primitive["attributes"]["POSITION"], "<f4"),
        ("faces", primitive["indices"], "<u4"),
    ):
        _, arrays[name] = content(document, binary, number, kind)
        del document["accessors"][number]["bufferView"]
    options = {"preserve_order": True, "quantization_bits": 16} | options
    encoded = DracoPy.encode(**arrays, **options)
    primitive["extensions"] = {
        "KHR_draco_mesh_compression": {
            "bufferView": add_view(document, binary, encoded),
            "attributes": {"POSITION": 0},
        }
    }
    document["extensionsRequired"] = ["KHR_draco_mesh_compression"]


def compress_with_meshopt(
    kind: str, indices: str, document: dict[str, Any], binary: bytearray
) -> None:
    """Compress the positions and triangles of the first mesh, the skin, with a filter or none."""
    primitive = document["meshes"][0]["primitives"][0]
    place, positions = content(document, binary, primitive["attributes"]["POSITION"], "<f4")
    indices_place, triangles = content(document, binary, primitive["indices"], "<u4")
    rows = positions if kind == "NONE" else meshopt.encode_filter_exp(positions, 20)
    _replace_by_compressed(document, binary, place, rows, {"mode": "ATTRIBUTES", "filter": kind})
    _replace_by_compressed(document, binary, indices_place, triangles.ravel(), {"mode": indices})
    document["extensionsRequired"] = ["EXT_meshopt_compression"]


def _replace_by_compressed(
    document: dict[str, Any],
    binary: bytearray,
    place: slice,
    rows: NDArray[Any],
    description: dict[str, str],
) -> None:
    encoded = meshopt.encode_gltf_buffer(rows, description["mode"])
    binary[place] = bytes(place.stop - place.start)
    view = next(view for view in document["bufferViews"] if view["byteOffset"] == place.start)
    view["extensions"] = {
        "EXT_meshopt_compression": {
            "buffer": 0,
            "byteOffset": len(binary),
            "byteLength": len(encoded),
            "byteStride": rows.strides[0],
            "count": len(rows),
            **description,
        }
    }
    binary += encoded + b"\0" * (-len(encoded) % 4)


@pytest.mark.parametrize(
    "change",
    [
        *(names_in_primitives, names_in_accessors, no_scenes, one_eye_mirrored, lights),
        *(texture_of_an_extension, null_binds, data_uri, draco),
        *(texture_of_an_unknown_extension, several_scenes, nothing_to_draw, sparse_shapes),
        partial(draco, create_metadata=True),
        partial(compress_with_meshopt, "NONE", "TRIANGLES"),
        partial(compress_with_meshopt, "EXPONENTIAL", "INDICES"),
        *(partial(transform, kind) for kind in TRANSFORMS),
    ],
)
def test_reads_files_of_other_programs(
    tmp_path: Path, change: Callable[[dict[str, Any], bytearray], None]
) -> None:
    head = read_glb(edit(write_glb(tmp_path / "my.glb", meshes(SHAPES)), change))
    assert shape_error(head, JAW) < 0.25
    assert shape_error(head, SHAPES["eyeBlinkLeft"]) < 0.04
    assert np.abs(head.eye_centers - ORIGINAL.eye_centers).max() < 0.01
    for part in ("skin", "eye_right"):  # the triangles face outwards
        normals, wanted = (model.normals[model.part(part).vertices] for model in (head, ORIGINAL))
        assert (normals * wanted).sum(axis=1).mean() > 0.9


@pytest.mark.parametrize(
    "wrong", [{"byteLength": 20}, {"count": -1}, {"byteStride": 0}, {"mode": "X"}]
)
def test_rejects_damaged_compressed_data(tmp_path: Path, wrong: dict[str, Any]) -> None:
    def change(document: dict[str, Any], binary: bytearray) -> None:
        compress_with_meshopt("NONE", "TRIANGLES", document, binary)
        for view in document["bufferViews"]:
            view.get("extensions", {}).get("EXT_meshopt_compression", {}).update(wrong)

    path = edit(write_glb(tmp_path / "my.glb", meshes({"jawOpen": SHAPES["jawOpen"]})), change)
    with pytest.raises(UserError, match=r"my\.glb: the file is damaged"):
        read_glb(path)


@pytest.mark.parametrize("preserve_order", [True, False], ids=["sequential", "edgebreaker"])
def test_limits_the_size_of_a_draco_mesh_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preserve_order: bool
) -> None:
    path = write_glb(tmp_path / "my.glb", meshes({"jawOpen": SHAPES["jawOpen"]}))
    edit(path, partial(draco, preserve_order=preserve_order))
    monkeypatch.setattr(glb_file, "MAX_BYTES", path.stat().st_size + 1000)
    monkeypatch.setattr(DracoPy, "decode", lambda _: pytest.fail("the mesh was decoded"))
    with pytest.raises(UserError, match="it is larger than"):
        read_glb(path)


@pytest.mark.parametrize(
    ("size", "problem"),
    [
        ((700_000, 2_100_000), "a mesh has 700000 triangles; reduce it to 666666"),
        ((12, 3_000_000), "a mesh has 3000000 points; reduce it to 2000000"),
    ],
)
def test_limits_the_points_of_a_draco_mesh_because_its_attributes_are_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], problem: str
) -> None:
    path = edit(write_glb(tmp_path / "my.glb", meshes({"jawOpen": SHAPES["jawOpen"]})), draco)
    monkeypatch.setattr(glb_file, "read_mesh_size", lambda _: size)
    monkeypatch.setattr(DracoPy, "decode", lambda _: pytest.fail("the mesh was decoded"))
    with pytest.raises(UserError, match=problem):
        read_glb(path)


def test_rejects_a_draco_mesh_that_needs_too_much_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(_: bytes) -> None:
        raise MemoryError

    path = edit(write_glb(tmp_path / "my.glb", meshes({"jawOpen": SHAPES["jawOpen"]})), draco)
    monkeypatch.setattr(DracoPy, "decode", decode)
    with pytest.raises(UserError, match=r"my\.glb: a Draco mesh needs far more memory"):
        read_glb(path)


def test_applies_default_weights_of_other_shapes_only(tmp_path: Path) -> None:
    """The shapes of speech start at rest; the others, such as the shape of the nose, stay."""

    def change(document: dict[str, Any], _binary: bytearray) -> None:
        for mesh in document["meshes"]:
            names = mesh.get("extras", {}).get("targetNames", [])
            mesh["weights"] = [float(name in ("jawOpen", "Nose")) for name in names]

    nose = neutral_faps(stretch_l_nose=400, stretch_r_nose=400)
    path = write_glb(tmp_path / "my.glb", meshes({"jawOpen": SHAPES["jawOpen"], "Nose": nose}))
    plain, head = read_glb(path), read_glb(edit(path, change))
    rows = plain.part("skin").vertices
    moved = head.vertices[rows] - plain.vertices[rows]
    wanted = ORIGINAL.deform(nose) - ORIGINAL.vertices
    scale = np.ptp(plain.vertices[:, 0]) / np.ptp(ORIGINAL.vertices[:, 0])
    assert moved == pytest.approx(scale * wanted[ORIGINAL.part("skin").vertices], abs=1e-4)


def test_the_content_decides_between_text_and_binary(tmp_path: Path) -> None:
    document, binary = read_chunks(write_glb(tmp_path / "my.gltf", meshes(SHAPES)))
    assert shape_error(load_head(str(tmp_path / "my.gltf")), JAW) < 0.25
    data_uri(document, binary)
    (tmp_path / "my.glb").write_text(json.dumps(document), encoding="utf-8-sig")
    assert shape_error(load_head(str(tmp_path / "my.glb")), JAW) < 0.25


def test_reads_a_gltf_with_its_buffer_in_its_folder_only(tmp_path: Path) -> None:
    document, binary = read_chunks(write_glb(tmp_path / "my.glb", meshes(SHAPES)))
    (tmp_path / "my face.bin").write_bytes(binary)
    gltf = tmp_path / "my.gltf"

    def load(uri: str) -> Head:
        document["buffers"][0]["uri"] = uri
        gltf.write_text(json.dumps(document), encoding="utf-8")
        return load_head(str(gltf))

    assert shape_error(load("my%20face.bin"), JAW) < 0.25
    for uri in ("../my.bin", "/etc/hostname", "file:///etc/hostname", "%2e%2e/my.bin"):
        with pytest.raises(UserError, match="not in its folder"):
            load(uri)
    with pytest.raises(UserError, match=r"my\.gltf: its file 'other.bin' is missing; copy it"):
        load("other.bin")


def describe_vrm(
    version: int, bones: Mapping[str, int] = MappingProxyType({})
) -> Callable[[dict[str, Any], bytearray], None]:
    """Make a VRM, whose expressions replace the names of the morph targets."""

    def change(document: dict[str, Any], _binary: bytearray) -> None:
        expressions: dict[str, list[tuple[int, int]]] = {}
        for mesh, entry in enumerate(document["meshes"]):
            for index, name in enumerate(entry.pop("extras", {}).get("targetNames", [])):
                expressions.setdefault(name, []).append((mesh, index))
        add_vrm(document, version, expressions, bones)
        if version == 0:
            wrap_scene(document, rotation=[0, 1, 0, 0])

    return change


@pytest.mark.parametrize("version", [0, 1])
def test_a_vrm_with_five_vowels_speaks(tmp_path: Path, version: int) -> None:
    shapes = {name: VRM.basis[VRM.names.index(name)] for name in ("aa", "ih", "ou", "ee", "oh")}
    path = edit(write_glb(tmp_path / "my.vrm", meshes(shapes)), describe_vrm(version))
    head = load_head(str(path))
    assert shape_error(head, AA) < 0.1
    assert shape_error(head, OCULUS.basis[OCULUS.names.index("ou")]) < 0.1
    assert head.deform(AA)[head.part("skin").vertices][:, 2].max() > 0  # it looks along z


@pytest.mark.parametrize("version", [0, 1])
@pytest.mark.parametrize("fap", ["yaw_l_eyeball", "pitch_l_eyeball", "yaw_r_eyeball"])
def test_eye_bones_of_a_vrm_turn_the_eyes(tmp_path: Path, version: int, fap: str) -> None:
    names = ("aa", "ih", "ou", "ee", "oh", "blinkLeft", "blinkRight")
    shapes = {name: VRM.basis[VRM.names.index(name)] for name in names}
    parts = meshes(shapes)
    for part in parts:
        part.name = part.name.replace("eye_", "ball_")
    path = write_glb(tmp_path / "my.vrm", parts)
    bones = [{"children": [1, 2]}, *({"translation": p} for p in ORIGINAL.eye_centers.tolist())]
    bind = np.tile(np.eye(4, dtype="<f4"), (3, 1, 1))
    bind[1:, 3, :3] = -ORIGINAL.eye_centers  # column-major
    joints = {"ball_left": 1, "ball_right": 2}
    add_skeleton(path, bones, lambda name: joints.get(name, 0), bind)
    nodes = {"head": len(parts), "leftEye": len(parts) + 1, "rightEye": len(parts) + 2}
    head = load_head(str(edit(path, describe_vrm(version, nodes))))
    faps = neutral_faps(**{fap: 15_000})
    eye = "left" if "_l_" in fap else "right"
    turned, wanted = (
        (model.deform(faps) - model.vertices)[model.part(part).vertices]
        for model, part in ((head, f"ball_{eye}"), (ORIGINAL, f"eye_{eye}"))
    )
    scale = np.linalg.norm(np.diff(head.eye_centers, axis=0)) / np.linalg.norm(
        np.diff(ORIGINAL.eye_centers, axis=0)
    )
    assert np.linalg.norm(turned / scale - wanted) < 0.2 * np.linalg.norm(wanted)


def test_rejects_a_file_with_two_avatars(tmp_path: Path) -> None:
    def double(document: dict[str, Any], _binary: bytearray) -> None:
        count = len(document["nodes"])
        document["nodes"] += [node | {"translation": [1, 0, 0]} for node in document["nodes"]]
        document["scenes"][0]["nodes"] += [count + i for i in range(count)]

    with pytest.raises(UserError, match="several faces; export only one"):
        read_glb(edit(write_glb(tmp_path / "my.glb", meshes(SHAPES)), double))
