"""Reads the pieces of a user's mesh file (OBJ, PLY or GLB) in common axes."""

import codecs
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from kouxing.services.driver import picture
from kouxing.services.driver.head.glb_file import GlbFile, check_glb
from kouxing.services.driver.head.glb_pieces import read_pieces
from kouxing.services.driver.head.mesh_pieces import MeshPiece
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, read_file

MAX_MESH_BYTES = 32 << 20
MAX_WORDS = 3_000_000
MESH_SUFFIXES = (".obj", ".glb", ".ply")
_PICTURES = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
_NO_DIFFUSE = [102, 102, 102]  # trimesh's default
_SKIN_COLOR = (0.58, 0.40, 0.32)  # linear, for meshes without color


def read_mesh(path: Path) -> list[MeshPiece]:
    """Read the triangles of a mesh file; a GLB is read in its skeleton's rest pose.

    Raises ``UserError`` if the file cannot be read, has no triangles, or is too large.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise UserError(f"{path}: use a mesh in one of the formats {', '.join(MESH_SUFFIXES)}")
    if suffix == ".glb":
        with check_glb(path):
            pieces = read_pieces(GlbFile(path))
    else:
        with check_content(path, "a mesh; export it again"):
            meshes = _load_meshes(path, suffix)
            pieces = [_parse_trimesh(mesh) for mesh in meshes if len(getattr(mesh, "faces", ()))]
    if not pieces:
        raise UserError(f"{path} has no faces; export the mesh with its triangles")
    return pieces


def _load_meshes(path: Path, suffix: str) -> list[Any]:
    """Read the meshes of an OBJ or PLY file, with the materials and images that it names."""
    content = _read_obj(path) if suffix == ".obj" else read_file(path, MAX_MESH_BYTES)
    if content.count(b" ") + content.count(b"\n") > MAX_WORDS:  # trimesh would need minutes
        raise UserError(f"{path} has more than {MAX_WORDS} words; decimate the mesh")
    files = _NamedFiles(str(path))
    options: dict[str, Any] = {"split_objects": True} if suffix == ".obj" else {}
    with warnings.catch_warnings(action="ignore"):  # trimesh warns when it guesses
        scene = trimesh.load_scene(
            io.BytesIO(content), file_type=suffix[1:], resolver=files, process=False, **options
        )
    if files.error is not None:
        raise files.error
    return list(scene.dump())


def _read_obj(path: Path) -> bytes:
    """Return an OBJ file without a byte order mark; each statement is on one line."""
    content = read_file(path, MAX_MESH_BYTES).removeprefix(codecs.BOM_UTF8)
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").replace(b"\\\n", b" ")


class _NamedFiles(trimesh.resolvers.FilePathResolver):
    """Reads the files that a mesh names. The last error is kept, because trimesh ignores errors."""

    error: UserError | None = None

    def get(self, name: str) -> bytes:
        """Return the content of a file in the mesh's folder or below."""
        path = Path(self.parent, name.strip())
        try:
            if not path.resolve().is_relative_to(Path(self.parent).resolve()):
                raise UserError(
                    f"{self.file_path}: it refers to {name!r} outside its folder; copy it there"
                )
            content = read_file(path, MAX_MESH_BYTES)
            if path.suffix.lower() != ".mtl":
                _check_picture(path, content)
        except UserError as error:
            self.error = error if path.exists() else self.error
            raise
        return content


def _check_picture(path: Path, content: bytes) -> None:
    with check_content(path, "a picture"):
        image = Image.open(io.BytesIO(content), formats=_PICTURES)
        if image.width * image.height > picture.MAX_PIXELS:
            raise ValueError(f"it has more than {picture.MAX_PIXELS / 1e6:.0f} million pixels")


def _parse_trimesh(mesh: Any) -> MeshPiece:
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    triangles = np.asarray(mesh.faces, dtype=np.int64)
    if not np.isfinite(vertices).all():
        raise ValueError("a coordinate is not finite")
    if triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError("a triangle refers to a missing vertex")
    visual, texture = mesh.visual, b""
    uv, colors = np.zeros((len(vertices), 2)), np.full((len(vertices), 3), _SKIN_COLOR)
    if getattr(visual, "uv", None) is not None and len(visual.uv) == len(vertices):
        uv = np.asarray(visual.uv, dtype=np.float64) * [1, -1] + [0, 1]  # this package has v down
        image = getattr(visual.material, "image", None)
        diffuse = getattr(visual.material, "diffuse", None)
        if image is not None:
            texture = picture.encode(np.asarray(image.convert("RGBA"), dtype=np.uint8))
            colors[:] = 1.0
        elif diffuse is not None and list(diffuse)[:3] != _NO_DIFFUSE:
            colors[:] = (np.asarray(diffuse, dtype=np.float64)[:3] / 255) ** 2
    vertex_colors = getattr(visual, "vertex_attributes", {}).get("color")
    if getattr(visual, "kind", None) == "vertex":
        vertex_colors = visual.vertex_colors
    if vertex_colors is not None and len(vertex_colors) == len(vertices):
        colors = (np.asarray(vertex_colors, dtype=np.float64)[:, :3] / 255) ** 2
    return MeshPiece(
        name=str(mesh.metadata.get("name", "part")),
        vertices=vertices,
        triangles=triangles,
        uv=uv,
        colors=colors,
        texture=texture,
        material={},
        head_weight=None,
    )


def numbered_vertices(mesh: Path, pieces: list[MeshPiece]) -> tuple[Doubles, dict[str, Doubles]]:
    """Return the vertices (V, 3) in file order: all of them, and by mesh name.

    Raises ``UserError`` if a vertex line of an OBJ file is invalid.
    """
    # the pieces of an OBJ file repeat a vertex for each texture coordinate
    if mesh.suffix.lower() != ".obj":
        return np.concatenate([p.vertices for p in pieces]), {p.name: p.vertices for p in pieces}
    rows: list[list[float]] = []
    starts: dict[str, int] = {}
    for line in _read_obj(mesh).decode("utf-8", "replace").split("\n"):
        words = line.split()
        if words[:1] == ["v"]:
            try:
                x, y, z = map(float, words[1:4])
            except ValueError:
                raise UserError(
                    f"{mesh}: {line.strip()!r} is not a valid vertex; export the mesh again"
                ) from None
            rows.append([x, y, z])
        elif words[:1] in (["o"], ["g"]) and len(words) > 1:
            starts.setdefault(words[1], len(rows))
    vertices = np.array(rows)
    ends = [*starts.values(), len(rows)][1:]  # none if the file names no mesh
    named = {
        name: vertices[a:b] for (name, a), b in zip(starts.items(), ends, strict=True) if b > a
    }
    return vertices, named if len(named) > 1 else {}
