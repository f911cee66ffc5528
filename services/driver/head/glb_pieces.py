"""Reads the meshes of a GLB in common axes, with their shapes and skeleton.

The shapes of a mesh are its morph targets. In a VRM, an expression is also a shape: a weighted sum
of morph targets of several meshes (``VRM`` of version 0, ``VRMC_vrm`` of version 1).
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from kouxing.services.driver import picture
from kouxing.services.driver.head.glb_file import GlbFile
from kouxing.services.driver.head.mesh_pieces import MeshPiece
from kouxing.shared.arrays import Doubles, Integers
from kouxing.shared.errors import UserError

MAX_VERTICES = 300_000
MAX_TRIANGLES = 1_000_000
MAX_PIECES = 2_000
MAX_SHIFTS = 20_000_000  # displacements of all morph targets
MAX_TEXTURE_PIXELS = 2 * picture.MAX_PIXELS  # sum over all textures
MAX_COORDINATE = 1e9
_JAW_BONES = ("jaw", "jawroot", "lowerjaw")
_LOOK_RAD = {"Out": 0.43, "Down": 0.31}  # rotation of the eyes at full weight of ARKit's shapes


def read_pieces(glb: GlbFile) -> list[MeshPiece]:
    """Return the meshes of the scene, with the shapes and joints that move them."""
    nodes = glb.nodes()
    matrices = dict(nodes)
    turn_fractions = _turn_fractions(glb, matrices)
    expressions = _expressions(glb)
    pieces: list[MeshPiece] = []
    num_vertices = num_triangles = num_shifts = 0
    for number, matrix in nodes:
        node = glb.item("nodes", number)
        if "mesh" not in node:
            continue
        mesh = glb.item("meshes", node["mesh"])
        binds = expressions[f"node {number}"] + expressions[f"mesh {node['mesh']}"]
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) < 4 or "POSITION" not in primitive["attributes"]:
                continue  # points, lines, or nothing
            count = int(glb.item("accessors", primitive["attributes"]["POSITION"])["count"])
            num_vertices += count
            num_shifts += count * (len(primitive.get("targets", [])) + len(binds))
            for limit, count_so_far, what in (  # a small file may refer to the same data repeatedly
                (MAX_VERTICES, num_vertices, "vertices; decimate it"),
                (MAX_SHIFTS, num_shifts, "displacements; remove morph targets"),
                (MAX_TRIANGLES, num_triangles, "triangles; decimate it"),
                (MAX_PIECES, len(pieces) + 1, "meshes; join them"),
            ):
                if count_so_far > limit:
                    raise UserError(f"it has more than {limit} {what}")
            piece = _piece(glb, node, mesh, primitive, matrices, matrix, turn_fractions, binds)
            if piece.head_weight is None and turn_fractions:
                piece.head_weight = np.full(len(piece.vertices), turn_fractions.get(number, 0.0))
            pieces.append(piece)
            num_triangles += len(piece.triangles)
    if not any(len(piece.triangles) for piece in pieces):
        raise UserError("it has no triangles; export it with its mesh")
    _check_textures(pieces)
    return pieces


def _check_textures(pieces: list[MeshPiece]) -> None:
    """Decode every texture once to check it, and convert formats outside the glTF core to PNG."""
    known = {b"": b""}
    num_pixels = 0
    for piece in pieces:
        if piece.texture not in known:
            pixels = picture.decode(piece.texture, piece.name)
            num_pixels += pixels.shape[0] * pixels.shape[1]
            if num_pixels > MAX_TEXTURE_PIXELS:
                raise UserError(
                    f"its textures have more than {MAX_TEXTURE_PIXELS} pixels; reduce them"
                )
            standard = piece.texture.startswith((b"\x89PNG", b"\xff\xd8"))
            known[piece.texture] = piece.texture if standard else picture.encode(pixels)
        piece.texture = known[piece.texture]


def _turn_fractions(glb: GlbFile, nodes: dict[int, Doubles]) -> dict[int, float]:
    """Return each node's fraction of the head rotation: 1 below a node "head", less on the neck."""
    fraction: dict[int, float] = {}
    bones = find_bones(glb)
    for number in nodes:  # parents come first
        bone = bones.get(number)
        if bone in ("head", "neck"):
            fraction[number] = 1.0 if bone == "head" else max(0.4, fraction.get(number, 0.0))
        for child in glb.item("nodes", number).get("children", []):
            fraction[int(child)] = fraction.get(number, 0.0)
    return fraction if any(value == 1.0 for value in fraction.values()) else {}


def find_bones(glb: GlbFile) -> dict[int, str]:
    """Return the bones by node: all bones of a VRM, otherwise head, neck and jaw by name."""
    extensions = glb.json.get("extensions", {})
    old_bones = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    new_bones = extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {})
    if old_bones or new_bones:
        return {entry["node"]: entry["bone"] for entry in old_bones} | {
            entry["node"]: bone for bone, entry in new_bones.items()
        }
    words = [
        re.split(r"[.:|_ ]", str(node.get("name", "")).lower())[-1]
        for node in glb.json.get("nodes", [])
    ]
    known = {"head": "head", "neck": "neck", **dict.fromkeys(_JAW_BONES, "jaw")}
    return {number: known[word] for number, word in enumerate(words) if word in known}


def _uses_eye_bones(glb: GlbFile) -> bool:
    """Return whether a VRM rotates its eyes with bones, not with expressions."""
    extensions = glb.json.get("extensions", {})
    old = extensions.get("VRM", {}).get("firstPerson", {}).get("lookAtTypeName")
    new = extensions.get("VRMC_vrm", {}).get("lookAt", {}).get("type")
    return bool(old == "Bone" or new == "bone")


Binds = list[tuple[str, int, float]]  # name of an expression, target, weight


def _expressions(glb: GlbFile) -> defaultdict[str, Binds]:
    """Return the name, target and weight of a VRM's expressions, by "node N" or "mesh N"."""
    binds: defaultdict[str, Binds] = defaultdict(list)
    extensions = glb.json.get("extensions", {})
    groups = extensions.get("VRM", {}).get("blendShapeMaster", {}).get("blendShapeGroups", [])
    for group in groups:
        preset = group.get("presetName", "unknown")
        name = group["name"] if preset == "unknown" else preset
        for bind in group.get("binds") or []:
            weight = float(bind.get("weight", 100)) / 100
            binds[f"mesh {bind['mesh']}"].append((str(name), int(bind["index"]), weight))
    kinds = extensions.get("VRMC_vrm", {}).get("expressions", {})
    for name, expression in (kinds.get("custom", {}) | kinds.get("preset", {})).items():
        for bind in expression.get("morphTargetBinds") or []:
            key = f"node {bind['node']}"
            binds[key].append((name, int(bind["index"]), float(bind.get("weight", 1))))
    return binds


def _piece(
    glb: GlbFile,
    node: dict[str, Any],
    mesh: dict[str, Any],
    primitive: dict[str, Any],
    matrices: dict[int, Doubles],
    matrix: Doubles,
    turn_fractions: dict[int, float],
    binds: Binds,
) -> MeshPiece:
    material = glb.item("materials", primitive["material"]) if "material" in primitive else {}
    base, uv_name = _texture(material)
    attributes = glb.attributes(
        primitive, {"POSITION", "COLOR_0", "JOINTS_0", "WEIGHTS_0", uv_name}
    )
    points = attributes["POSITION"]
    count = len(points)
    index = np.arange(count)
    if "indices" in attributes:
        indices = attributes["indices"].astype(np.int64)
        index = indices[:, 0] if indices.shape[1] == 1 else np.array([-1])
    if points.shape[1] != 3 or (len(index) and not 0 <= index.min() <= index.max() < count):
        raise ValueError("a triangle refers to a missing vertex")
    uv = _moved_uv(attributes.get(uv_name, np.zeros((count, 2)))[:, :2], base)
    factor = material.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1.0] * 4)
    colors = np.ones((count, 3)) * np.array(factor)[:3]
    if "COLOR_0" in attributes:
        colors *= attributes["COLOR_0"][:, :3]
    texture = glb.image(base["index"]) if base else b""
    skin = None
    if "skin" in node and "JOINTS_0" in attributes:
        skin = _Skin(glb, node["skin"], attributes, matrices)
    placed = skin.matrices() if skin else np.broadcast_to(matrix, (count, 4, 4))
    if not len(uv) == len(colors) == len(placed) == count:
        raise ValueError("the attributes of a mesh have different lengths")
    shapes, rest = _shapes(glb, node, mesh, primitive, placed[:, :3, :3], binds)
    vertices = np.einsum("vij,vj->vi", placed[:, :3, :3], points) + placed[:, :3, 3]
    weight = jaw_arm = None
    if skin and turn_fractions:
        weight, jaw_arm = skin.mean(turn_fractions), skin.jaw_arm(vertices)
        if _uses_eye_bones(glb):
            shapes = skin.eye_look_shapes(vertices) | shapes
    for values in (vertices, uv, colors, *shapes.values()):
        if not (np.abs(values) < MAX_COORDINATE).all():
            raise ValueError("a coordinate or color is not finite or very large")
    return MeshPiece(
        name=str(node.get("name") or mesh.get("name") or "part"),
        vertices=vertices,
        triangles=_corners(index, primitive.get("mode", 4)),
        uv=uv,
        colors=colors,
        texture=texture,
        material=material,
        head_weight=weight,
        shapes=shapes,
        rest=rest,
        is_mirrored=count > 0 and bool(np.linalg.det(placed[0, :3, :3]) < 0),
        jaw_arm=jaw_arm,
    )


def _texture(material: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the reference to a material's texture, and the name of its coordinates."""
    base = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    moved = base.get("extensions", {}).get("KHR_texture_transform", {})
    return base, f"TEXCOORD_{moved.get('texCoord', base.get('texCoord', 0))}"


def _moved_uv(uv: Doubles, base: dict[str, Any]) -> Doubles:
    """Apply KHR_texture_transform."""
    moved = base.get("extensions", {}).get("KHR_texture_transform")
    if moved is None:
        return uv
    cos, sin = np.cos(moved.get("rotation", 0)), np.sin(moved.get("rotation", 0))
    turn = np.array([[cos, -sin], [sin, cos]])
    placed: Doubles = (uv * moved.get("scale", (1, 1))) @ turn + moved.get("offset", (0, 0))
    return placed


def _shapes(
    glb: GlbFile,
    node: dict[str, Any],
    mesh: dict[str, Any],
    primitive: dict[str, Any],
    placed: Doubles,
    binds: Binds,
) -> tuple[dict[str, Doubles], dict[str, float]]:
    """Return the displacements (V, 3) of the expressions and morph targets, and weights at rest."""
    shifts = {}
    for number, target in enumerate(primitive.get("targets", [])):
        if "POSITION" in target:
            shift = glb.accessor(target["POSITION"])
            if shift.shape != placed.shape[:2]:
                raise ValueError(f"morph target {number} does not match its mesh")
            shifts[number] = np.einsum("vij,vj->vi", placed, shift)
    shapes: dict[str, Doubles] = {}
    for name, number, weight in binds:
        if number in shifts:
            shapes[name] = shapes.get(name, 0.0) + weight * shifts[number]
    weights = node.get("weights") or mesh.get("weights") or []
    rest = {}
    for number, name in enumerate(_target_names(glb, mesh, primitive)):
        if number in shifts and name not in shapes:
            shapes[name] = shifts[number]
            if number < len(weights) and weights[number]:
                rest[name] = float(weights[number])
    return shapes, rest


def _corners(index: Integers, mode: int) -> Integers:
    """Return the corners (F, 3) of triangles, of a strip (5) or of a fan (6)."""
    if mode == 4:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    if mode == 6:
        return np.stack([np.full(max(len(index) - 2, 0), index[0]), index[1:-1], index[2:]], axis=1)
    corners = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    corners[1::2] = corners[1::2, ::-1]
    return corners


def _target_names(glb: GlbFile, mesh: dict[str, Any], primitive: dict[str, Any]) -> list[str]:
    """Return a name for each morph target; programs write them in different places."""
    targets = primitive.get("targets", [])
    for owner in (primitive, mesh):
        names = (owner.get("extras") or {}).get("targetNames", [])
        if isinstance(names, list) and names:
            return [str(name) for name in names]
    entries = [
        glb.item("accessors", target["POSITION"]) if "POSITION" in target else {}
        for target in targets
    ]
    return [str(entry.get("name", number)) for number, entry in enumerate(entries)]


class _Skin:
    """The joints that move the vertices of a mesh, and their weights."""

    def __init__(
        self, glb: GlbFile, skin: object, attributes: dict[str, Doubles], nodes: dict[int, Doubles]
    ) -> None:
        entry = glb.item("skins", skin)
        self._glb = glb
        self._nodes = nodes
        self._joints = [int(joint) for joint in entry["joints"]]
        self._bones = np.array([nodes[joint] for joint in self._joints])
        if "inverseBindMatrices" in entry:
            bind = glb.accessor(entry["inverseBindMatrices"])[: len(self._joints)]
            self._bones = self._bones @ bind.reshape(-1, 4, 4).transpose(0, 2, 1)
        index, weights = attributes["JOINTS_0"].astype(np.int64), attributes["WEIGHTS_0"]
        if index.shape != weights.shape or (index.size and index.max() >= len(self._joints)):
            raise ValueError("a mesh refers to a missing joint")
        self._index = index
        self._weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)

    def matrices(self) -> Doubles:
        """Return each vertex's rest matrix (V, 4, 4)."""
        matrices: Doubles = np.einsum("vk,vkij->vij", self._weights, self._bones[self._index])
        return matrices

    def mean(self, values: Mapping[int, float]) -> Doubles:
        """Return each vertex's weighted mean (V,) of joint values. Missing values count as 0."""
        joint_values = np.array([values.get(joint, 0.0) for joint in self._joints])
        mean: Doubles = (self._weights * joint_values[self._index]).sum(axis=1)
        return mean

    def jaw_arm(self, vertices: Doubles) -> Doubles | None:
        """Return the weighted positions (V, 3) relative to a jaw bone, if it moves vertices.

        A VRM's jaw bone is ignored, because programs often choose a wrong one.
        """
        jaw = next((joint for joint, bone in find_bones(self._glb).items() if bone == "jaw"), None)
        is_vrm = self._glb.json.get("extensions", {}).keys() & {"VRM", "VRMC_vrm"}
        if jaw not in self._nodes or is_vrm:
            return None
        below = {jaw}
        for node in self._nodes:  # parents come first
            if node in below:
                below |= set(self._glb.item("nodes", node).get("children", []))
        weight = self.mean(dict.fromkeys(below, 1.0))[:, None]
        if not weight.any():
            return None
        return weight * (vertices - self._nodes[jaw][:3, 3])

    def eye_look_shapes(self, vertices: Doubles) -> dict[str, Doubles]:
        """Return ARKit's eye shapes: the displacements (V, 3) by rotations of the eye bones."""
        bones = find_bones(self._glb)
        is_old = "VRM" in self._glb.json["extensions"]  # version 0 looks along -z
        out, down = _LOOK_RAD["Out"], _LOOK_RAD["Down"]
        shapes = {}
        for side, outward in (("Left", 1.0), ("Right", -1.0)):
            eyes = [joint for joint in self._joints if bones.get(joint) == f"{side.lower()}Eye"]
            weight = self.mean(dict.fromkeys(eyes, 1.0))[:, None]
            if not weight.any():
                continue
            arm = weight * (vertices - self._nodes[eyes[0]][:3, 3])
            shapes[f"eyeLookOut{side}"] = outward * out * np.cross([0, 1, 0], arm)
            shapes[f"eyeLookDown{side}"] = (-down if is_old else down) * np.cross([1, 0, 0], arm)
        return shapes
