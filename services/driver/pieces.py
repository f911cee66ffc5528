"""The meshes that a user's file holds, in one frame, and how they become the parts of a head."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from services.driver import picture
from services.driver.glb_file import BadGlbError, Float64, Glb
from services.driver.head import FORMAT
from shared.errors import UserError

MAX_VERTICES = 300_000
MAX_TRIANGLES = 1_000_000
MAX_PIECES = 2_000
MAX_SHIFTS = 20_000_000  # vertices that all morph targets together move
MAX_TEXTURE_PIXELS = 2 * picture.MAX_PIXELS  # of all
MAX_MESH_BYTES = 256 * 1024 * 1024  # of a file
_LARGEST = 1e9  # coordinate
MESH_SUFFIXES = (".obj", ".glb", ".ply")
_FINEST_M = 2e-9  # smaller displacements by one FAP unit are left out
_WHITE = np.full((2, 2, 3), 255, np.uint8)
_NODES = ("kouxing", "body", "head")  # of an exported GLB
_LONGEST_NAME = 60
_NO_DIFFUSE = [102, 102, 102]  # what trimesh makes up
_SKIN_COLOUR = (0.58, 0.40, 0.32)  # linear, where a file brings none

Fields = dict[int, Float64]  # FAP: displacement (V, 3) by one unit, m


@dataclass(slots=True)
class Piece:
    """A primitive in the axes of the scene."""

    name: str
    vertices: Float64
    triangles: NDArray[np.int64]
    uv: Float64
    colors: Float64
    texture: bytes
    material: dict[str, Any]
    head_weight: Float64 | None  # None: no skeleton says
    shapes: dict[str, Float64] = field(default_factory=dict)  # by lower-case name


def plain(name: str) -> str:
    """Reduce a target's name to what tells it apart: ``Face.mouthSmile_L`` is mouthsmileleft."""
    word = re.split(r"[.:|]", name)[-1]
    for short, side in (("l", "left"), ("r", "right")):
        word = re.sub(rf"[_\- ]{short}$", side, word, flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]", "", word.lower())


def read_pieces(glb: Glb) -> list[Piece]:
    """Gather the triangles of the scene, with what moves them."""
    nodes = glb.nodes()
    places = dict(nodes)
    followers = _followers(glb, places)
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
            for limit, found, what in (  # a small file may name the same data many times
                (MAX_VERTICES, num_vertices, "vertices; decimate it"),
                (MAX_SHIFTS, num_shifts, "displacements; leave out morph targets"),
                (MAX_TRIANGLES, num_triangles, "triangles; decimate it"),
                (MAX_PIECES, len(pieces) + 1, "meshes; join them"),
            ):
                if found > limit:
                    raise BadGlbError(f"it has more than {limit} {what}")
            piece = _piece(glb, node, mesh, primitive, places, place, followers)
            if piece.head_weight is None and followers:
                piece.head_weight = np.full(len(piece.vertices), followers.get(number, 0.0))
            pieces.append(piece)
            num_triangles += len(piece.triangles)
    if not any(len(piece.triangles) for piece in pieces):
        raise BadGlbError("it has no triangles")
    _check_textures(pieces)
    return pieces


def _check_textures(pieces: list[Piece]) -> None:
    """Decode every texture once; one that glTF's core does not know becomes a PNG."""
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


def _followers(glb: Glb, nodes: dict[int, Float64]) -> dict[int, float]:
    """Say how far each node follows the head's turn: all below a node named so, the neck less."""
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
    followers: dict[int, float],
) -> Piece:
    attributes = primitive["attributes"]
    points = glb.accessor(attributes["POSITION"])
    count = len(points)
    index = np.arange(count)
    if "indices" in primitive:
        given = glb.accessor(primitive["indices"]).astype(np.int64)
        index = given[:, 0] if given.shape[1] == 1 else np.array([-1])
    if points.shape[1] != 3 or (len(index) and not 0 <= index.min() <= index.max() < count):
        raise BadGlbError("a triangle has a corner that does not exist")
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
        placed, weight = _skinned(glb, node["skin"], attributes, places, followers)
    if not len(uv) == len(colors) == len(placed) == count:
        raise BadGlbError("the attributes of a mesh differ in length")
    shapes = {}
    targets = primitive.get("targets", [])
    target_names = (mesh.get("extras") or {}).get("targetNames", [])
    for name, target in zip(target_names, targets, strict=False):
        if "POSITION" in target:
            shift = glb.accessor(target["POSITION"])
            if shift.shape != points.shape:
                raise BadGlbError(f"morph target {name} does not fit its mesh")
            shapes[plain(str(name))] = np.einsum("vij,vj->vi", placed[:, :3, :3], shift)
    vertices = np.einsum("vij,vj->vi", placed[:, :3, :3], points) + placed[:, :3, 3]
    for values in (vertices, uv, colors, *shapes.values()):
        if not (np.abs(values) < _LARGEST).all():
            raise BadGlbError("a coordinate or colour is not finite, or very large")
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
    followers: dict[int, float],
) -> tuple[Float64, Float64 | None]:
    """Matrix (V, 4, 4) of every vertex in the rest pose, and its share of the head's turn (V,)."""
    entry = glb.item("skins", skin)
    joints = [int(joint) for joint in entry["joints"]]
    bones = np.array([places[joint] for joint in joints])
    if "inverseBindMatrices" in entry:
        bind = glb.accessor(entry["inverseBindMatrices"])[: len(joints)]
        bones = bones @ bind.reshape(-1, 4, 4).transpose(0, 2, 1)
    which = glb.accessor(attributes["JOINTS_0"]).astype(np.int64)
    weights = glb.accessor(attributes["WEIGHTS_0"])
    if which.shape != weights.shape or (which.size and which.max() >= len(joints)):
        raise BadGlbError("a mesh hangs on a joint that does not exist")
    weights = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
    share = np.array([followers.get(joint, 0.0) for joint in joints])
    placed = np.einsum("vk,vkij->vij", weights, bones[which])
    return placed, (weights * share[which]).sum(axis=1) if followers else None


def weld(vertices: NDArray[Any], uv: NDArray[Any]) -> NDArray[np.int64]:
    """Find for each vertex (V,) the first one that stands in its place.

    Vertices with the same texture coordinates, too, are kept apart: nothing but a slit, such as
    between closed lips, makes a program write a vertex twice like that.
    """
    _, first, place = np.unique(
        np.round(vertices / 1e-6).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    place = place.ravel()
    both = np.concatenate([place[:, None], np.round(uv * 65535)], axis=1)
    _, kind, count = np.unique(both, axis=0, return_inverse=True, return_counts=True)
    doubled = np.zeros(len(first), dtype=bool)
    doubled[place[count[kind.ravel()] > 1]] = True
    welded: NDArray[np.int64] = np.where(doubled[place], np.arange(len(vertices)), first[place])
    return welded


def part_names(pieces: list[Piece]) -> list[str]:
    """Name every part differently, eyeballs as the rest of the program knows them."""
    names: list[str] = []
    taken, last = set(_NODES), dict[str, int]()
    for piece in pieces:
        word = piece.name.lower()
        name = re.sub(r"[^\w-]", "_", piece.name)[:_LONGEST_NAME]
        if "eye" in word and not re.search("brow|lash|lid|wear|glass", word):
            for side, short in (("left", "l"), ("right", "r")):
                if side in word or re.search(rf"(^|[_. ]){short}([_. ]|$)", word):
                    name = f"eye_{side}"
        unique = name
        while unique in taken:
            last[name] = last.get(name, 1) + 1
            unique = f"{name}_{last[name]}"
        taken.add(unique)
        names.append(unique)
    return names


def read_mesh(path: Path) -> list[Piece]:
    """Read the triangles of a mesh file; GLB with its skeleton's rest pose, others by trimesh.

    Raises
    ------
    UserError
        If the file cannot be read, has no triangles, or is too large.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise UserError(f"{path}: give a mesh in one of the forms {', '.join(MESH_SUFFIXES)}")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if path.stat().st_size > MAX_MESH_BYTES:
        raise UserError(f"{path} is larger than {MAX_MESH_BYTES // 2**20} MiB; decimate the mesh")
    try:
        if suffix == ".glb":
            pieces = read_pieces(Glb(path))
        else:
            with warnings.catch_warnings(action="ignore"):  # trimesh's, on its own guesses
                options: dict[str, Any] = {"split_objects": True} if suffix == ".obj" else {}
                scene = trimesh.load_scene(path, process=False, **options)
            meshes: list[Any] = list(scene.dump())
            pieces = [_from_trimesh(mesh) for mesh in meshes if len(getattr(mesh, "faces", ()))]
    except BadGlbError as error:
        raise UserError(f"{path}: {error}") from error
    except Exception as error:  # trimesh's loaders raise whatever goes wrong in them
        raise UserError(f"{path} is no intact mesh ({error})") from error
    if not pieces:
        raise UserError(f"{path} has no faces; export the mesh with its triangles")
    return pieces


def _from_trimesh(mesh: Any) -> Piece:
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if not np.isfinite(vertices).all():
        raise ValueError("a coordinate is not finite")
    visual, texture = mesh.visual, b""
    uv, colors = np.zeros((len(vertices), 2)), np.full((len(vertices), 3), _SKIN_COLOUR)
    if getattr(visual, "uv", None) is not None and len(visual.uv) == len(vertices):
        uv = np.asarray(visual.uv, dtype=np.float64) * [1, -1] + [0, 1]  # ours run downwards
        image = getattr(visual.material, "image", None)
        diffuse = getattr(visual.material, "diffuse", None)
        if image is not None:
            texture = picture.encode(np.asarray(image.convert("RGBA"), dtype=np.uint8))
            colors[:] = 1.0
        elif diffuse is not None and list(diffuse)[:3] != _NO_DIFFUSE:
            colors[:] = (np.asarray(diffuse, dtype=np.float64)[:3] / 255) ** 2
    given = getattr(visual, "vertex_attributes", {}).get("color")
    if getattr(visual, "kind", None) == "vertex":
        given = visual.vertex_colors
    if given is not None and len(given) == len(vertices):
        colors = (np.asarray(given, dtype=np.float64)[:, :3] / 255) ** 2
    return Piece(
        name=str(mesh.metadata.get("name", "part")),
        vertices=vertices,
        triangles=np.asarray(mesh.faces, dtype=np.int64),
        uv=uv,
        colors=colors,
        texture=texture,
        material={},
        head_weight=None,
    )


def pack(
    pieces: list[Piece],
    *,
    fields: list[Fields],
    head_weight: Float64,
    fapu: dict[str, float],
    feature_points: dict[str, int],
    eye_centres: Float64,
) -> dict[str, NDArray[Any]]:
    """Arrange pieces as the arrays of a head's file, see ``services.driver.head.assemble``.

    Parameters
    ----------
    pieces
        In the head's axes, m.
    fields
        Of each piece.
    head_weight
        Share of the head's turn of all vertices (V,).
    fapu, feature_points, eye_centres
        As in ``Head``.
    """
    first = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    bounds = np.cumsum([0] + [len(piece.triangles) for piece in pieces])
    faps, ends, moved, shifts = [], [0], [], []
    for fap in sorted({fap for of_piece in fields for fap in of_piece}):
        for of_piece, start in zip(fields, first, strict=False):
            if fap in of_piece:
                rows = np.flatnonzero(np.abs(of_piece[fap]).max(axis=1) > _FINEST_M)
                moved.append(rows + start)
                shifts.append(of_piece[fap][rows])
        faps.append(fap)
        ends.append(sum(map(len, moved)))
    textures = {"plain": picture.encode(_WHITE)}
    names = []
    for piece in pieces:
        same = [name for name, data in textures.items() if data == piece.texture]
        names.append("plain" if not piece.texture else (same or [f"image {len(textures)}"])[0])
        textures.setdefault(names[-1], piece.texture)
    surfaces = [piece.material.get("pbrMetallicRoughness", {}) for piece in pieces]
    vertices = np.concatenate([piece.vertices for piece in pieces]).astype(np.float32)
    uv = np.concatenate([piece.uv for piece in pieces]).astype(np.float32)
    colors = np.clip(np.concatenate([piece.colors for piece in pieces]), 0, 1)
    triangles = [piece.triangles + at for piece, at in zip(pieces, first, strict=False)]
    return {
        "format": np.array(FORMAT),
        "vertices": vertices,
        "welds": weld(vertices, uv).astype(np.uint32),
        "uv": uv * np.float32(65535),
        "colors": (np.sqrt(colors) * 255).astype(np.float32),
        "head_weight": (head_weight * 255).astype(np.float32),
        "triangles": np.concatenate(triangles).astype(np.uint32),
        "part_names": np.array(part_names(pieces)),
        "part_textures": np.array(names),
        "part_roughness": np.clip([float(s.get("roughnessFactor", 0.6)) for s in surfaces], 0, 1),
        "part_transparent": np.array(
            [piece.material.get("alphaMode", "OPAQUE") != "OPAQUE" for piece in pieces]
        ),
        "part_double_sided": np.array(
            [bool(piece.material.get("doubleSided", False)) for piece in pieces]
        ),
        "part_vertices": np.stack([first[:-1], first[1:], first[1:]], axis=1),
        "part_triangles": np.stack([bounds[:-1], bounds[1:], bounds[:-1], bounds[1:]], axis=1),
        "fapu_names": np.array(list(fapu)),
        "fapu": np.array(list(fapu.values())),
        "feature_point_names": np.array(list(feature_points), dtype=str),
        "feature_points": np.array(list(feature_points.values()), dtype=np.int64),
        "eye_centres": eye_centres.astype(np.float32),
        "field_faps": np.array(faps, dtype=np.int64),
        "field_units": np.ones(len(faps)),
        "field_bounds": np.array(ends),
        "field_vertices": np.concatenate([*moved, np.zeros(0, np.int64)]).astype(np.uint32),
        "field_shifts": np.concatenate([*shifts, np.zeros((0, 3))]).astype(np.float32),
        **{f"texture_{key}": np.frombuffer(data, np.uint8) for key, data in textures.items()},
    }
