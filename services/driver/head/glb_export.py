"""Exports a head as binary glTF (GLB), which a browser or a game engine can animate with FAPs.

Khronos glTF 2.0. Every displacement FAP is a morph target with sparse accessors, named after the
FAP. Each of ARKit's 52 shapes is also a morph target, the sum of FAPs in ``arkit.tsv``. Animate
either the FAPs or the ARKit shapes. The rotations (FAPs 23 to 26 and 48 to 50) rotate nodes.

``extras.kouxing`` of the root node and of the scene describes how to convert FAPs:

- weight = FAP / ``unitsPerWeight``, never clamped;
- angle in rad = FAP * 1e-5 about ``rotation.axis`` of the node ``rotation.node``; rotations of one
  node combine as yaw * pitch * roll.

Nodes: ``kouxing`` > ``body`` (joint) > ``garment``, ``head`` (joint) > ``eye_left``, ``eye_right``,
``teeth_upper``, ``teeth_lower``, ``tongue``, ``hair``, ``brows``, ``lashes``. ``skin`` is a mesh
next to the root, skinned to both joints. Lengths are in meters, y is up, the face looks along z.

``extras.coarse`` of a mesh is an accessor of alternative indices for viewers without a graphics
card: fewer triangles on the first vertices of the mesh.

For a motion, the animation ``speech`` sets the weights of every mesh and the rotating nodes,
linearly between frames.

The suffix ``.vrm`` makes a VRM 1.0 avatar instead, see ``vrm``.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kouxing.services.driver.head import vrm
from kouxing.services.driver.head.glb_document import (
    ELEMENT_BUFFER,
    MAX_SHORT_VERTICES,
    GlbDocument,
)
from kouxing.services.driver.head.head import ASSETS, Head, HeadPart
from kouxing.services.driver.head.morph_targets import (
    ARKIT_MORPHS,
    AVATAR_MORPHS,
    FAP_MORPHS,
    MorphTarget,
    units_per_weight,
)
from kouxing.services.driver.render import shaders
from kouxing.services.driver.render.renderer import BACKGROUND
from kouxing.services.driver.render.scene import place_camera
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.face.high_level_faps import EXPRESSION_NAMES, EXPRESSIONS, VISEME_NAMES, VISEMES
from kouxing.shared.face.shapes import ARKIT

TimedFaps: TypeAlias = tuple[float, Floats]  # media time in seconds, FAPs (68,)

_ROTATION_OF = {
    23: ("eye_left", (0, 1, 0)),
    24: ("eye_right", (0, 1, 0)),
    25: ("eye_left", (1, 0, 0)),
    26: ("eye_right", (1, 0, 0)),
    48: ("head", (1, 0, 0)),
    49: ("head", (0, 1, 0)),
    50: ("head", (0, 0, 1)),
}
_HAIR_ALPHA_CUTOFF = 0.4
_TURNS_EYES = np.isin(np.arange(1, NUM_FAPS + 1), (23, 24, 25, 26))


def export_glb(
    head: Head, path: str | Path, motion: Sequence[TimedFaps] = (), *, as_arkit: bool = False
) -> None:
    """Write a head as ``.glb`` or ``.vrm``.

    ``motion`` holds the frames of an animation, empty for a ``.vrm``; with ``as_arkit`` the
    animation uses ARKit's shapes instead of FAPs.

    Raises ``UserError`` if the suffix is different, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".glb", ".vrm"):
        raise UserError(f"{path}: use a name that ends in .glb or .vrm")
    is_avatar = suffix == ".vrm"
    morphs = AVATAR_MORPHS if is_avatar else FAP_MORPHS + ARKIT_MORPHS
    document = GlbDocument()
    sampler = document.add(
        "samplers", {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}
    )
    textures: dict[str, int] = {}
    for name, encoded in head.textures.items():
        kind = "image/png" if encoded.startswith(b"\x89PNG") else "image/jpeg"
        image = document.add(
            "images", {"bufferView": document.add_view(encoded), "mimeType": kind, "name": name}
        )
        textures[name] = document.add("textures", {"sampler": sampler, "source": image})

    nodes: dict[str, int] = {}
    for part in head.parts:
        nodes[part.name] = _part_node(document, head, part, textures, morphs)
    carriers = {part.name: _attachment(head, part) for part in head.parts}
    on_head, on_body, skinned = (
        [nodes[name] for name, carrier in carriers.items() if carrier == kind]
        for kind in ("head", "body", "both")
    )
    nodes["head"] = document.add("nodes", _parent("head", on_head))
    nodes["body"] = document.add("nodes", _parent("body", [nodes["head"], *on_body]))
    if is_avatar:
        _add_skeleton(document, nodes)
    root = nodes["hips" if is_avatar else "body"]
    extras = {"kouxing": _description(head)}
    nodes["kouxing"] = document.add("nodes", _parent("kouxing", [root]) | {"extras": extras})
    identity = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)).reshape(2, 16)
    matrices = document.add_accessor(identity, "MAT4", target=None)
    joints = [nodes["body"], nodes["head"]]
    document.add(
        "skins", {"joints": joints, "skeleton": nodes["body"], "inverseBindMatrices": matrices}
    )
    if len(motion):
        _add_animation(document, nodes, motion, as_arkit=as_arkit)
    avatar = {"VRMC_vrm": _vrm(document, head, nodes)} if is_avatar else {}
    material_extensions = {
        name for entry in document.json["materials"] for name in entry.get("extensions", ())
    }
    used = [*avatar, *sorted(material_extensions)]
    document.save(
        Path(path),
        scene=0,
        scenes=[{"name": head.name, "nodes": [nodes["kouxing"], *skinned], "extras": extras}],
        **({"extensionsUsed": used} if used else {}),
        **({"extensions": avatar} if avatar else {}),
    )


def _add_skeleton(document: GlbDocument, nodes: dict[str, int]) -> None:
    """Attach the node ``body`` to an avatar's bones."""
    entries = document.json["nodes"]
    for bone, parent, position in vrm.BONES:
        if bone not in nodes:
            nodes[bone] = document.add("nodes", {"name": bone})
        entries[nodes[bone]]["translation"] = position
        if parent:
            entries[nodes[parent]].setdefault("children", []).append(nodes[bone])


def _vrm(document: GlbDocument, head: Head, nodes: dict[str, int]) -> dict[str, Any]:
    bindings: dict[str, list[tuple[int, int]]] = {morph.name: [] for morph in AVATAR_MORPHS}
    for number, node in enumerate(document.json["nodes"]):
        if "mesh" in node:
            names = document.json["meshes"][node["mesh"]]["extras"].get("targetNames", ())
            for index, name in enumerate(names):
                bindings[name].append((number, index))
    x, y, z = head.eye_centers.mean(axis=0).tolist()
    return vrm.build_extension(head.name, nodes, bindings, (x, y, z), is_free=_is_built_in(head))


def _add_animation(
    document: GlbDocument, nodes: dict[str, int], motion: Sequence[TimedFaps], *, as_arkit: bool
) -> None:
    """Add an animation of all weights and rotations."""
    times_s = np.array([time_s for time_s, _ in motion], np.float32)
    faps = np.array([faps for _, faps in motion], np.float32)  # (num_frames, 68)
    weights = {
        fap.name: faps[:, fap.number - 1] / np.float32(units_per_weight(fap.fapu)) for fap in FAPS
    }
    turned = {node for node, _ in _ROTATION_OF.values() if node in nodes}
    if as_arkit:
        shapes = np.array([ARKIT.weights(row) for row in faps]).T
        weights = dict(zip(ARKIT.names, shapes, strict=True))
        turned &= {"head"}  # ARKit has shapes for eye rotation
    curves = {(node, "rotation"): _rotation(node, faps) for node in sorted(turned)}
    for name, node in nodes.items():
        if (mesh := document.json["nodes"][node].get("mesh")) is None:
            continue
        names = document.json["meshes"][mesh].get("extras", {}).get("targetNames", ())
        if names:
            still = np.zeros(len(faps), np.float32)
            curves[name, "weights"] = np.stack(
                [weights.get(target, still) for target in names], axis=1
            )
    times = document.add_accessor(times_s, "SCALAR", target=None, bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    for (name, path), values in curves.items():
        kind = "VEC4" if path == "rotation" else "SCALAR"
        flat = values if path == "rotation" else values.ravel()
        output = document.add_accessor(flat.astype(np.float32), kind, target=None)
        channels.append({"sampler": len(samplers), "target": {"node": nodes[name], "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    document.add("animations", {"name": "speech", "samplers": samplers, "channels": channels})


def _rotation(node: str, faps: Floats) -> Doubles:
    """Return the quaternions (num_frames, 4) of a node that FAPs rotate: yaw, pitch, roll."""
    angles = np.zeros((len(faps), 3))
    for fap, (turned, axis) in _ROTATION_OF.items():
        if turned == node:
            angles[:, axis.index(1)] = faps[:, fap - 1] * RADIANS_PER_ANGLE_UNIT
    quaternions: Doubles = Rotation.from_euler("YXZ", angles[:, [1, 0, 2]]).as_quat()
    return quaternions


def _attachment(head: Head, part: HeadPart) -> str:
    """Return what a part is attached to: "head", "body", or "both" (the neck)."""
    weight = np.round(head.head_weight[part.vertices] * 255)
    return "head" if weight.min() == 255 else "body" if weight.max() == 0 else "both"


def _parent(name: str, children: list[int]) -> dict[str, Any]:
    return {"name": name} | ({"children": children} if children else {})


def _part_node(
    document: GlbDocument,
    head: Head,
    part: HeadPart,
    textures: dict[str, int],
    morphs: Sequence[MorphTarget],
) -> int:
    vertices = head.vertices[part.vertices]
    node: dict[str, Any] = {"name": part.name}
    if part.name in ("eye_left", "eye_right"):
        center = head.eye_centers[int(part.name == "eye_right")]
        node["translation"] = center.tolist()
        vertices = vertices - center
    colors = np.ones((len(vertices), 4))
    colors[:, :3] = head.colors[part.vertices]
    attributes = {
        "POSITION": document.add_accessor(vertices, "VEC3", bounds=True),
        "NORMAL": document.add_accessor(head.normals[part.vertices], "VEC3"),
        "TEXCOORD_0": document.add_accessor(
            np.round(head.uv[part.vertices] * 65535).astype(np.uint16), "VEC2", normalized=True
        ),
        "COLOR_0": document.add_accessor(
            np.round(colors * 65535).astype(np.uint16), "VEC4", normalized=True
        ),
    }
    if _attachment(head, part) == "both":
        turning = np.round(head.head_weight[part.vertices] * 255).astype(np.uint8)
        joints, weights = np.zeros((2, len(vertices), 4), np.uint8)
        joints[:, 1] = turning > 0  # an unused joint must be 0
        weights[:, 0], weights[:, 1] = 255 - turning, turning
        attributes["JOINTS_0"] = document.add_accessor(joints, "VEC4")
        attributes["WEIGHTS_0"] = document.add_accessor(weights, "VEC4", normalized=True)
        node["skin"] = 0

    def add_indices(triangles: NDArray[np.uint32]) -> int:
        indices = (triangles - part.vertices.start).ravel()
        number = np.uint16 if len(vertices) <= MAX_SHORT_VERTICES else np.uint32
        return document.add_accessor(indices.astype(number), "SCALAR", target=ELEMENT_BUFFER)

    triangles = head.triangles[part.triangles]
    coarse = head.coarse_triangles[head.parts.index(part)]
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": add_indices(triangles),
        "material": document.add("materials", _material(part, textures, cel=head.cel)),
    }
    mesh: dict[str, Any] = {"name": part.name, "primitives": [primitive], "extras": {}}
    if len(coarse) < len(triangles):
        mesh["extras"]["coarse"] = add_indices(coarse)
    targets, names = _targets(document, head, part, morphs)
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
        mesh["extras"]["targetNames"] = names
    node["mesh"] = document.add("meshes", mesh)
    return document.add("nodes", node)


def _material(part: HeadPart, textures: dict[str, int], *, cel: bool) -> dict[str, Any]:
    wrap, gloss, shine = shaders.MATERIALS.get(part.name, shaders.PLAIN_MATERIAL)
    material: dict[str, Any] = {
        "name": part.name,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": textures[part.texture]},
            "metallicFactor": 0.0,
            "roughnessFactor": part.roughness,
        },
        "extras": {"kouxing": {"wrap": wrap, "gloss": gloss, "shine": shine}},
    }
    if part.name == shaders.HAIR_PART:  # blended triangles would need sorting
        material |= {"alphaMode": "MASK", "alphaCutoff": _HAIR_ALPHA_CUTOFF}
    elif part.transparent:
        material["alphaMode"] = "BLEND"
    relief = textures.get(f"{part.texture}_normal")
    if part.name in shaders.EYE_PARTS:
        material["extensions"] = {
            "KHR_materials_clearcoat": {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.03}
        }
    elif cel:  # physical light would show folds that a drawing omits; shadows are in the colors
        material["extensions"] = {"KHR_materials_unlit": {}}
    if relief is not None and not cel:
        material["normalTexture"] = {"index": relief}
    if part.double_sided:
        material["doubleSided"] = True
    return material


def _targets(
    document: GlbDocument, head: Head, part: HeadPart, morphs: Sequence[MorphTarget]
) -> tuple[list[dict[str, int]], list[str]]:
    """Return the morph targets of a part, and their names."""
    count = part.vertices.stop - part.vertices.start
    fields = head.basis[3 * part.vertices.start : 3 * part.vertices.stop].T.toarray()  # (68, 3 V)
    shifts = np.array([morph.faps for morph in morphs]) @ fields
    targets: list[dict[str, int]] = []
    names = []
    for morph, row in zip(morphs, shifts, strict=True):
        shift = row.reshape(count, 3)
        turn = np.where(_TURNS_EYES, morph.faps, 0).astype(np.float32)
        if morph.turns_eyes and part.name.startswith("eye") and turn.any():
            shift = shift + (head.deform(turn) - head.vertices)[part.vertices]
        moved = np.flatnonzero(np.abs(shift).max(axis=1) > morph.min_shift_m)
        if len(moved):
            accessor = document.add_sparse_vectors(moved, shift[moved], count)
            targets.append({"POSITION": accessor})
            names.append(morph.name)
    return targets, names


def _is_built_in(head: Head) -> bool:
    return (ASSETS / f"{head.name}.npz").is_file()


def _description(head: Head) -> dict[str, Any]:
    """Return the data that a viewer needs to convert FAPs into weights and angles."""
    faps: list[dict[str, Any]] = []
    turning = {"head"} | {part.name for part in head.parts}
    for fap in FAPS[2:]:
        entry: dict[str, Any] = {"number": fap.number, "name": fap.name, "fapu": fap.fapu}
        node, axis = _ROTATION_OF.get(fap.number, ("", ()))
        if node in turning:
            entry["rotation"] = {"node": node, "axis": axis}
        else:
            entry["unitsPerWeight"] = units_per_weight(fap.fapu)
        faps.append(entry)
    view = place_camera(head)
    return {
        "version": 1,
        "cel": head.cel,
        "faps": faps,
        "fapu": head.fapu,
        "featurePoints": {
            name: [round(float(c), 6) for c in head.vertices[vertex]]
            for name, vertex in head.feature_points.items()
        },
        "camera": {
            "position": view.position,
            "target": view.target,
            "fovYDegrees": view.field_of_view_deg,
        },
        "background": BACKGROUND[0],
        "visemes": _shapes(VISEME_NAMES, VISEMES),
        "expressions": _shapes(EXPRESSION_NAMES, EXPRESSIONS),
        "arkit": _shapes(ARKIT.names, ARKIT.basis),
    } | ({"license": "CC0-1.0"} if _is_built_in(head) else {})


def _shapes(names: tuple[str, ...], values: Floats) -> list[dict[str, Any]]:
    """Return shapes as low-level FAPs."""
    return [
        {"name": name, "faps": {FAPS[i].name: round(float(row[i]), 1) for i in np.flatnonzero(row)}}
        for name, row in zip(names, values, strict=True)
    ]
