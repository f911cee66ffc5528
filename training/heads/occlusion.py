"""Ambient occlusion, baked into the vertex colors: how much of the sky each vertex sees.

It is estimated from many depth images. H. Landis, "Production-ready global illumination", SIGGRAPH
course 16, 2002.
"""

import moderngl
import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.render.renderer import standalone_context
from kouxing.training.heads import subdivision
from kouxing.training.heads.hair_styles import Hair
from kouxing.training.heads.measures import neckline_height
from kouxing.training.heads.parts import HeadPiece

Float = NDArray[np.float64]

_SIZE = 512  # px
_NUM_DIRECTIONS = 160
_VERTEX = """
#version 330
uniform mat4 view;
in vec3 place;
void main() { gl_Position = view * vec4(place, 1.0); }
"""
_FRAGMENT = """
#version 330
out float depth;
void main() { depth = gl_FragCoord.z; }
"""


def openness(vertices: Float, normals: Float, triangles: NDArray[np.int64]) -> Float:
    """Estimate the cosine-weighted fraction of the sphere that is visible from points, (V,).

    ``vertices`` and ``normals`` (V, 3) are the points, in dm. Only ``triangles`` (F, 3) occlude.
    """
    index = np.arange(_NUM_DIRECTIONS) + 0.5  # a Fibonacci lattice on the sphere
    polar, turn = np.arccos(1 - 2 * index / _NUM_DIRECTIONS), np.pi * (1 + 5**0.5) * index
    ways = np.stack(
        [np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], axis=1
    )
    context = standalone_context()
    program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
    array = context.vertex_array(
        program,
        [(context.buffer(vertices.astype("f4").tobytes()), "3f", "place")],
        context.buffer(triangles.astype("i4").tobytes()),
    )
    image = context.texture((_SIZE, _SIZE), 1, dtype="f4")
    target = context.framebuffer([image], context.depth_renderbuffer((_SIZE, _SIZE)))
    context.enable(moderngl.DEPTH_TEST)
    middle = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    reach = np.linalg.norm(vertices - middle, axis=1).max() * 1.01
    seen, total = np.zeros(len(vertices)), np.zeros(len(vertices))
    for way in ways:
        up = np.array([0.0, 1.0, 0.0]) if abs(way[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        right = np.cross(up, way)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(way, right), -way]) / reach
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = axes, -axes @ middle
        program["view"] = tuple(view.T.ravel())
        target.use()
        target.clear(red=1.0, depth=1.0)
        array.render()
        depth = np.frombuffer(image.read(), "f4").reshape(_SIZE, _SIZE)
        # lift the points off their triangles
        place = (vertices + 0.012 * normals - middle) @ axes.T
        column = np.clip(((place[:, 0] + 1) / 2 * _SIZE).astype(int), 0, _SIZE - 1)
        row = np.clip(((place[:, 1] + 1) / 2 * _SIZE).astype(int), 0, _SIZE - 1)
        visible = (place[:, 2] + 1) / 2 <= depth[row, column] + 0.0015
        cosine = np.maximum(normals @ way, 0.0)
        seen += cosine * visible
        total += cosine
    context.release()
    return seen / np.maximum(total, 1e-9)


# an open mouth and drooping lids, for the occlusion of lips, teeth and lids
_OPEN = {
    3: 300, 4: -200, 8: -180, 9: -180, 5: -400, 10: -360, 11: -360, 51: -180, 55: -160, 56: -160,
    52: -360, 57: -320, 58: -320, 19: 650, 20: 650,
}  # fmt: skip


def _opened(piece: HeadPiece) -> Float:
    vertices = piece.part.vertices.copy()
    for fap, value in _OPEN.items():
        if fap in piece.fields:
            vertices += piece.fields[fap] * (value / 1024)
    return vertices


def shade(pieces: list[HeadPiece], layout: Float, cavity: NDArray[np.bool_], hair: Hair) -> None:
    """Bake the ambient occlusion into the vertex colors of a head's pieces; the first is the skin.

    ``layout`` (V, 3) are the skin's vertices on the reference head, dm. ``cavity`` (V,) are those
    that line the mouth.
    """
    solid = [p for p in pieces if p.name != "lashes"]
    offsets = np.cumsum([0] + [len(p.part.vertices) for p in solid])
    vertices = np.concatenate([_opened(p) for p in solid])
    normals = np.concatenate(
        [subdivision.vertex_normals(_opened(p), p.part.triangles) for p in solid]
    )

    def unhidden(with_hair: bool) -> Float:
        triangles = [
            p.part.triangles + first
            for p, first in zip(solid, offsets, strict=False)
            if p.name != "hair_tips" and (with_hair or p.name != "hair")
        ]
        return openness(vertices, normals, np.concatenate(triangles))

    # thin hair at the face would cast jagged shadows
    seen, seen_with_hair = unhidden(False), unhidden(True)
    for piece, first in zip(solid, offsets, strict=False):
        part = piece.part
        rows = slice(first, first + len(part.vertices))
        under_hair = np.full(len(part.vertices), float(piece.name.startswith("hair")))
        if piece.name == "skin":
            under_hair = hair.shaded(layout)
        light = (1 - under_hair) * seen[rows] + under_hair * seen_with_hair[rows]
        light = np.clip(light, 0, 1)[:, None]
        if piece.name == "skin":
            # the vertices behind the neckband are too sparse
            bare = np.clip((layout[:, 1:2] - neckline_height(layout[:, 2:]) - 0.02) / 0.22, 0, 1)
            light = bare * light + (1 - bare) * 0.55
            shaded = np.clip(0.10 + 1.0 * light, 0, 1) ** np.array([0.90, 1.0, 1.04])
            # ears under hair are darker than the sparse vertices suggest
            ear = np.clip((np.abs(layout[:, :1]) - 0.645) / 0.04, 0, 1)
            shaded *= 1 - 0.6 * ear * np.clip(2 * under_hair[:, None] - 1, 0, 1)
            lining = np.array([0.55, 0.17, 0.16]) * _into_mouth(layout[:, 2])
            part.colors = np.where(cavity[:, None], lining * (0.5 + 0.5 * shaded), shaded)
        elif piece.name == "garment":
            part.colors = np.repeat(0.6 + 0.4 * light, 3, axis=1)
        elif piece.name.startswith("eye"):
            lit = np.clip(
                0.95 - 2.2 * (part.vertices[:, 1:2] - part.vertices[0, 1] - 0.005) / 0.1, 0.45, 1.0
            )
            part.colors = np.repeat(lit, 3, axis=1)
        elif piece.name.startswith("hair"):
            part.colors = part.colors * (0.45 + 0.55 * light)
        elif piece.name.startswith("teeth"):
            part.colors = part.colors * (0.80 + 0.20 * np.clip(2 * light, 0, 1))
        elif piece.name == "tongue":
            lit = np.clip(0.5 + 1.5 * light, 0, 1) * _into_mouth(part.vertices[:, 2] + 0.22)
            part.colors = lit * np.array([1.0, 0.85, 0.85])


def _into_mouth(z: Float) -> Float:
    """Return the fraction (V, 1) of the light at a depth behind the lips."""
    inside = np.clip((z[:, None] - 0.75) / 0.5, 0, 1)
    return 0.02 + 0.98 * inside**2
