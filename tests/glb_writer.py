"""Writes small GLBs as other programs do (dense accessors, no kouxing extras), and reads GLBs."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass
class Mesh:
    name: str
    vertices: NDArray[Any]
    triangles: NDArray[Any]
    targets: dict[str, NDArray[Any]] = field(default_factory=dict)
    normals: NDArray[Any] | None = None
    uv: NDArray[Any] | None = None
    colors: NDArray[Any] | None = None  # (V, 3), linear
    texture: bytes = b""  # PNG


def write_glb(path: Path, meshes: list[Mesh], **rest: Any) -> Path:
    binary = bytearray()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews", "materials")},
        **rest,
    }

    def view(data: bytes) -> int:
        document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
        )
        binary.extend(data + b"\0" * (-len(data) % 4))
        return len(document["bufferViews"]) - 1

    def accessor(array: NDArray[Any], kind: str, component: int) -> int:
        entry = {"bufferView": view(array.tobytes()), "componentType": component, "type": kind}
        if kind == "VEC3":
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        document["accessors"].append(entry | {"count": len(array)})
        return len(document["accessors"]) - 1

    for mesh in meshes:
        attributes = {"POSITION": accessor(mesh.vertices.astype("<f4"), "VEC3", 5126)}
        if mesh.normals is not None:
            attributes["NORMAL"] = accessor(mesh.normals.astype("<f4"), "VEC3", 5126)
        if mesh.uv is not None:
            attributes["TEXCOORD_0"] = accessor(mesh.uv.astype("<f4"), "VEC2", 5126)
        if mesh.colors is not None:
            attributes["COLOR_0"] = accessor(mesh.colors.astype("<f4"), "VEC3", 5126)
        surface: dict[str, Any] = {}
        if mesh.texture:
            document.setdefault("images", []).append(
                {"bufferView": view(mesh.texture), "mimeType": "image/png"}
            )
            document.setdefault("textures", []).append({"source": len(document["images"]) - 1})
            surface["baseColorTexture"] = {"index": len(document["textures"]) - 1}
        document["materials"].append({"pbrMetallicRoughness": surface})
        primitive = {
            "attributes": attributes,
            "indices": accessor(mesh.triangles.astype("<u4").ravel(), "SCALAR", 5125),
            "material": len(document["materials"]) - 1,
        }
        entry: dict[str, Any] = {"primitives": [primitive]}
        if mesh.targets:
            primitive["targets"] = [
                {"POSITION": accessor(shift.astype("<f4"), "VEC3", 5126)}
                for shift in mesh.targets.values()
            ]
            entry["extras"] = {"targetNames": list(mesh.targets)}
        document["meshes"].append(entry)
        document["nodes"].append({"name": mesh.name, "mesh": len(document["meshes"]) - 1})
    document["buffers"] = [{"byteLength": len(binary)}]
    write_chunks(path, document, binary)
    return path


def write_chunks(path: Path, document: dict[str, Any], binary: bytes | bytearray) -> None:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + bytes(binary)
    )


def read_chunks(path: Path) -> tuple[dict[str, Any], bytearray]:
    """Return the description and the binary chunk of a GLB; check the headers."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    num_bytes, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, num_bytes) == (b"BIN\0", len(data) - 28 - size)
    return json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])


def add_accessor(
    document: dict[str, Any], binary: bytearray, array: Any, kind: str, component: int
) -> int:
    """Append an accessor; return its number."""
    place = {"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes}
    document["bufferViews"].append(place)
    view = len(document["bufferViews"]) - 1
    accessor = {"bufferView": view, "componentType": component, "type": kind, "count": len(array)}
    document["accessors"].append(accessor)
    binary += array.tobytes() + b"\0" * (-array.nbytes % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    return len(document["accessors"]) - 1


def add_skeleton(
    path: Path,
    bones: list[dict[str, Any]],
    joint_of: Callable[[str], int],
    bind: NDArray[Any] | None = None,
) -> None:
    """Add a chain of bones to a GLB, and skin each mesh to one of them.

    ``joint_of`` returns the number of a mesh's bone; ``bind`` are the inverse bind matrices.
    """
    if bind is None:
        bind = np.tile(np.eye(4, dtype="<f4"), (len(bones), 1, 1))
    document, binary = read_chunks(path)
    count = len(document["nodes"])
    document["nodes"] += [
        bone | ({"children": [count + number]} if number < len(bones) else {})
        for number, bone in enumerate(bones, 1)
    ]
    document["scenes"][0]["nodes"].append(count)
    accessor = add_accessor(document, binary, bind.reshape(-1, 16), "MAT4", 5126)
    used = [count + number for number in range(len(bones))]
    document["skins"] = [{"joints": used, "inverseBindMatrices": accessor}]
    for node in document["nodes"][:count]:
        attributes = document["meshes"][node["mesh"]]["primitives"][0]["attributes"]
        rows = document["accessors"][attributes["POSITION"]]["count"]
        which, weights = np.zeros((rows, 4), "u1"), np.zeros((rows, 4), "<f4")
        which[:, 0], weights[:, 0] = joint_of(node["name"]), 1
        attributes["JOINTS_0"] = add_accessor(document, binary, which, "VEC4", 5121)
        attributes["WEIGHTS_0"] = add_accessor(document, binary, weights, "VEC4", 5126)
        node["skin"] = 0
    write_chunks(path, document, binary)
