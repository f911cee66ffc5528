"""Reads the meshes of a GLB as pieces in common axes, with morph targets and skeleton."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from kouxing.services.driver import picture
from kouxing.services.driver.head.glb_file import BadGlbError, Float64, Glb
from kouxing.services.driver.head.pieces import Piece
from kouxing.shared.errors import UserError

MAX_VERTICES = 300_000
MAX_TRIANGLES = 1_000_000
MAX_PIECES = 2_000
MAX_SHIFTS = 20_000_000  # displacements of all morph targets
MAX_TEXTURE_PIXELS = 2 * picture.MAX_PIXELS  # sum over all textures
MAX_COORDINATE = 1e9


def plain(name: str) -> str:
    """Reduce a target's name to its distinctive part: ``Face.mouthSmile_L`` is mouthsmileleft."""
    word = re.split(r"[.:|]", name)[-1]
    for short, side in (("l", "left"), ("r", "right")):
        word = re.sub(rf"[_\- ]{short}$", side, word, flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]", "", word.lower())


def read_pieces(glb: Glb) -> list[Piece]:
    """Return the triangles of the scene with everything that moves them."""
    nodes = glb.nodes()
    places = dict(nodes)
    turn_shares = _turn_shares(glb, places)
    pieces: list[Piece] = []
    num_vertices = num_triangles = num_shifts = 0
    for number, place in nodes:
        node = glb.item("nodes", number)
        if "mesh" not in node:
            continue
        mesh = glb.item("meshes", node["mesh"])
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) != 4:
                continue  # points and lines
            count = int(glb.item("accessors", primitive["attributes"]["POSITION"])["count"])
            num_vertices += count
            num_shifts += count * len(primitive.get("targets", []))
            for limit, count_so_far, what in (  # a small file may refer to the same data repeatedly
                (MAX_VERTICES, num_vertices, "vertices; decimate it"),
                (MAX_SHIFTS, num_shifts, "displacements; remove morph targets"),
                (MAX_TRIANGLES, num_triangles, "triangles; decimate it"),
                (MAX_PIECES, len(pieces) + 1, "meshes; join them"),
            ):
                if count_so_far > limit:
                    raise BadGlbError(f"it has more than {limit} {what}")
            piece = _piece(glb, node, mesh, primitive, places, place, turn_shares)
            if piece.head_weight is None and turn_shares:
                piece.head_weight = np.full(len(piece.vertices), turn_shares.get(number, 0.0))
            pieces.append(piece)
            num_triangles += len(piece.triangles)
    if not any(len(piece.triangles) for piece in pieces):
        raise BadGlbError("it has no triangles")
    _check_textures(pieces)
    return pieces


def _check_textures(pieces: list[Piece]) -> None:
    """Decode every texture once; formats outside the glTF core are converted to PNG."""
    known = {b"": b""}
    num_pixels = 0
    for piece in pieces:
        if piece.texture not in known:
            try:
                pixels = picture.decode(piece.texture, piece.name)
            except UserError as error:
                raise BadGlbError(str(error)) from error
            num_pixels += pixels.shape[0] * pixels.shape[1]
            if num_pixels > MAX_TEXTURE_PIXELS:
                raise BadGlbError(f"its textures have more than {MAX_TEXTURE_PIXELS} pixels")
            standard = piece.texture.startswith((b"\x89PNG", b"\xff\xd8"))
            known[piece.texture] = piece.texture if standard else picture.encode(pixels)
        piece.texture = known[piece.texture]


def _turn_shares(glb: Glb, nodes: dict[int, Float64]) -> dict[int, float]:
    """Return each node's share of the head rotation: 1 below a node "head", less on the neck."""
    share: dict[int, float] = {}
    for number in nodes:  # parents come first
        node = glb.item("nodes", number)
        word = re.split(r"[.:|_ ]", str(node.get("name", "")).lower())[-1]
        if word in ("head", "neck"):
            share[number] = 1.0 if word == "head" else max(0.4, share.get(number, 0.0))
        for child in node.get("children", []):
            share[int(child)] = share.get(number, 0.0)
    return share if any(value == 1.0 for value in share.values()) else {}


def _piece(
    glb: Glb,
    node: dict[str, Any],
    mesh: dict[str, Any],
    primitive: dict[str, Any],
    places: dict[int, Float64],
    place: Float64,
    turn_shares: dict[int, float],
) -> Piece:
    attributes = primitive["attributes"]
    points = glb.accessor(attributes["POSITION"])
    count = len(points)
    index = np.arange(count)
    if "indices" in primitive:
        given = glb.accessor(primitive["indices"]).astype(np.int64)
        index = given[:, 0] if given.shape[1] == 1 else np.array([-1])
    if points.shape[1] != 3 or (len(index) and not 0 <= index.min() <= index.max() < count):
        raise BadGlbError("a triangle refers to a missing vertex")
    uv = (
        glb.accessor(attributes["TEXCOORD_0"])
        if "TEXCOORD_0" in attributes
        else np.zeros((count, 2))
    )
    material = glb.item("materials", primitive["material"]) if "material" in primitive else {}
    surface = material.get("pbrMetallicRoughness", {})
    colors = np.ones((count, 3)) * np.array(surface.get("baseColorFactor", [1.0] * 4))[:3]
    if "COLOR_0" in attributes:
        colors *= glb.accessor(attributes["COLOR_0"])[:, :3]
    texture = b""
    if "baseColorTexture" in surface:
        texture = glb.image(surface["baseColorTexture"]["index"])
    placed = np.broadcast_to(place, (count, 4, 4))
    weight = None
    if "skin" in node and "JOINTS_0" in attributes:
        placed, weight = _skinned(glb, node["skin"], attributes, places, turn_shares)
    if not len(uv) == len(colors) == len(placed) == count:
        raise BadGlbError("the attributes of a mesh have different lengths")
    shapes = {}
    targets = primitive.get("targets", [])
    target_names = (mesh.get("extras") or {}).get("targetNames", [])
    for name, target in zip(target_names, targets, strict=False):
        if "POSITION" in target:
            shift = glb.accessor(target["POSITION"])
            if shift.shape != points.shape:
                raise BadGlbError(f"morph target {name} does not match its mesh")
            shapes[plain(str(name))] = np.einsum("vij,vj->vi", placed[:, :3, :3], shift)
    vertices = np.einsum("vij,vj->vi", placed[:, :3, :3], points) + placed[:, :3, 3]
    for values in (vertices, uv, colors, *shapes.values()):
        if not (np.abs(values) < MAX_COORDINATE).all():
            raise BadGlbError("a coordinate or color is not finite or very large")
    return Piece(
        name=str(node.get("name") or mesh.get("name") or "part"),
        vertices=vertices,
        triangles=index[: len(index) // 3 * 3].reshape(-1, 3),
        uv=uv[:, :2],
        colors=colors,
        texture=texture,
        material=material,
        head_weight=weight,
        shapes=shapes,
    )


def _skinned(
    glb: Glb,
    skin: object,
    attributes: dict[str, Any],
    places: dict[int, Float64],
    turn_shares: dict[int, float],
) -> tuple[Float64, Float64 | None]:
    """Return each vertex's rest matrix (V, 4, 4) and its share of the head rotation (V,)."""
    entry = glb.item("skins", skin)
    joints = [int(joint) for joint in entry["joints"]]
    bones = np.array([places[joint] for joint in joints])
    if "inverseBindMatrices" in entry:
        bind = glb.accessor(entry["inverseBindMatrices"])[: len(joints)]
        bones = bones @ bind.reshape(-1, 4, 4).transpose(0, 2, 1)
    which = glb.accessor(attributes["JOINTS_0"]).astype(np.int64)
    weights = glb.accessor(attributes["WEIGHTS_0"])
    if which.shape != weights.shape or (which.size and which.max() >= len(joints)):
        raise BadGlbError("a mesh refers to a missing joint")
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    share = np.array([turn_shares.get(joint, 0.0) for joint in joints])
    placed = np.einsum("vk,vkij->vij", weights, bones[which])
    return placed, (weights * share[which]).sum(axis=1) if turn_shares else None
