"""Writes small GLBs as other programs do (dense accessors, no kouxing extras), and reads GLBs."""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

BONES = (
    *("hips", "spine", "head", "leftEye", "rightEye"),
    *(side + limb for side in ("left", "right") for limb in ("UpperArm", "LowerArm", "Hand")),
    *(side + limb for side in ("left", "right") for limb in ("UpperLeg", "LowerLeg", "Foot")),
)
VRM_0_NAMES = {"aa": "a", "ih": "i", "ou": "u", "ee": "e", "oh": "o"}
LOOK_SIDES = ("HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp")
LOOK_RANGES = [f"rangeMap{side}" for side in LOOK_SIDES]
LOOK_RANGE = {"inputMaxValue": 90.0, "outputScale": 90.0}
TRANSFORMS: dict[str, dict[str, list[float]]] = {  # of whole files; the unit is 1 cm
    "z up": {"scale": [100, 100, 100], "rotation": [2**-0.5, 0, 0, 2**-0.5]},
    "sideways": {"scale": [100, 100, 100], "rotation": [0, 2**-0.5, 0, 2**-0.5]},
    "oblique": {"scale": [100, 100, 100], "rotation": [0, np.sin(0.3), 0, np.cos(0.3)]},
    "upside down": {"scale": [100, 100, 100], "rotation": [0, 0, 1, 0]},
    "turned": {"scale": [100, 100, 100], "rotation": [0, 1, 0, 0]},
    "mirrored": {"scale": [100, 100, -100]},
}


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


def add_view(document: dict[str, Any], binary: bytearray, data: bytes) -> int:
    """Append data to the binary chunk; return the number of its buffer view."""
    place = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
    document["bufferViews"].append(place)
    binary += data + b"\0" * (-len(data) % 4)
    document["buffers"] = [{"byteLength": len(binary)}]
    return len(document["bufferViews"]) - 1


def add_accessor(
    document: dict[str, Any], binary: bytearray, array: NDArray[Any], kind: str, component: int
) -> int:
    """Append an accessor; return its number."""
    view = add_view(document, binary, array.tobytes())
    accessor = {"bufferView": view, "componentType": component, "type": kind, "count": len(array)}
    if kind == "VEC3":
        accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
    document["accessors"].append(accessor)
    return len(document["accessors"]) - 1


def write_glb(path: Path, meshes: list[Mesh], **rest: Any) -> Path:
    binary = bytearray()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews", "materials")},
        **rest,
    }

    accessor = partial(add_accessor, document, binary)
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
            view = add_view(document, binary, mesh.texture)
            image = {"bufferView": view, "mimeType": "image/png"}
            document.setdefault("images", []).append(image)
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


def edit(path: Path, change: Callable[[dict[str, Any], bytearray], object]) -> Path:
    """Change the description and the binary chunk of a GLB."""
    document, binary = read_chunks(path)
    change(document, binary)
    write_chunks(path, document, binary)
    return path


def wrap_scene(document: dict[str, Any], **transform: Any) -> None:
    """Put the whole scene under one node with a transform."""
    document["nodes"].append({"children": document["scenes"][0]["nodes"], **transform})
    document["scenes"][0]["nodes"] = [len(document["nodes"]) - 1]


def add_vrm(
    document: dict[str, Any],
    version: int,
    expressions: Mapping[str, Sequence[tuple[int, int]]],
    bones: Mapping[str, int],
) -> None:
    """Describe a GLB as VRM 0 or 1.

    ``expressions`` are (mesh, morph target) pairs by their names in VRM 1; ``bones`` are nodes.
    """
    if version == 1:
        node_of = {node["mesh"]: n for n, node in enumerate(document["nodes"]) if "mesh" in node}
        binds = {
            name: [{"node": node_of[mesh], "index": row, "weight": 1.0} for mesh, row in targets]
            for name, targets in expressions.items()
        }
        about: dict[str, Any] = {
            "specVersion": "1.0",
            "meta": {"name": "x", "authors": ["x"], "licenseUrl": "https://vrm.dev/licenses/1.0/"},
            "humanoid": {"humanBones": {bone: {"node": node} for bone, node in bones.items()}},
            "expressions": {"preset": {n: {"morphTargetBinds": b} for n, b in binds.items()}},
            "lookAt": {"type": "bone"} | dict.fromkeys(LOOK_RANGES, LOOK_RANGE),
        }
    else:
        binds = {
            VRM_0_NAMES.get(name, name): [
                {"mesh": mesh, "index": row, "weight": 100.0} for mesh, row in targets
            ]
            for name, targets in expressions.items()
        }
        groups = [{"name": "any", "presetName": n, "binds": b} for n, b in binds.items()]
        human_bones = [{"bone": bone, "node": node} for bone, node in bones.items()]
        about = {
            "meta": {"title": "x"},
            "humanoid": {"humanBones": human_bones},
            "blendShapeMaster": {"blendShapeGroups": groups},
            "firstPerson": {"lookAtTypeName": "Bone"},
        }
    extension = ("VRM", "VRMC_vrm")[version]
    document |= {"extensionsUsed": [extension], "extensions": {extension: about}}


def add_skeleton(
    path: Path,
    bones: list[dict[str, Any]],
    joint_of: Callable[[str], int],
    bind: NDArray[Any] | None = None,
) -> None:
    """Add bones to a GLB, and skin each mesh to one of them.

    The first bone is the root; ``children`` of a bone are indices of ``bones``. ``joint_of``
    returns the index of a mesh's bone; ``bind`` are the inverse bind matrices.
    """
    if bind is None:
        bind = np.tile(np.eye(4, dtype="<f4"), (len(bones), 1, 1))
    document, binary = read_chunks(path)
    count = len(document["nodes"])
    for bone in bones:
        children = [count + index for index in bone.get("children", ())]
        document["nodes"].append(bone | ({"children": children} if children else {}))
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
