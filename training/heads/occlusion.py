"""Ambient occlusion, baked into the vertex colors: how much of the sky each vertex sees.

It is estimated from many depth images. H. Landis, "Production-ready global illumination", SIGGRAPH
course 16, 2002.
"""

import moderngl
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kouxing.services.driver.render.renderer import create_offscreen_context
from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.training.heads import subdivision
from kouxing.training.heads.measures import neckline_height
from kouxing.training.heads.parts import Geometry, HeadPiece

_SKULL = np.array([0.0, 5.93, 0.42])  # its middle, dm
_HIDDEN = 0.002  # fraction of the sphere that is visible from a hidden vertex, at most
_TOOTH_SHOWN = 0.4  # a tooth with a smaller fraction of visible triangles is removed
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


def openness(vertices: Doubles, normals: Doubles, triangles: Integers) -> Doubles:
    """Estimate the cosine-weighted fraction of the sphere that is visible from points, (V,).

    ``vertices`` and ``normals`` (V, 3) are the points, in dm. Only ``triangles`` (F, 3) occlude.
    """
    index = np.arange(_NUM_DIRECTIONS) + 0.5  # a Fibonacci lattice on the sphere
    polar, turn = np.arccos(1 - 2 * index / _NUM_DIRECTIONS), np.pi * (1 + 5**0.5) * index
    directions = np.stack(
        [np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], axis=1
    )
    context = create_offscreen_context()
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
    for direction in directions:
        up = np.array([0.0, 1.0, 0.0]) if abs(direction[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        right = np.cross(up, direction)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(direction, right), -direction]) / reach
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
        # most light comes from above and from the front
        cosine = np.maximum(normals @ direction, 0.0) * np.exp(
            1.2 * direction[1] + 0.5 * direction[2]
        )
        seen += cosine * visible
        total += cosine
    context.release()
    return seen / np.maximum(total, 1e-9)


# an open mouth and drooping lids, for the occlusion of lips, teeth and lids
_OPEN_MOUTH = {
    3: 300, 4: -200, 8: -180, 9: -180, 5: -400, 10: -360, 11: -360, 51: -180, 55: -160, 56: -160,
    52: -360, 57: -320, 58: -320, 19: 650, 20: 650,
}  # fmt: skip


def _open_mouth_vertices(piece: HeadPiece) -> Doubles:
    vertices = piece.geometry.vertices.copy()
    for fap, value in _OPEN_MOUTH.items():
        if fap in piece.fields:
            vertices += piece.fields[fap] * (value / 1024)
    return vertices


def bake_occlusion(pieces: list[HeadPiece], layout: Doubles, cavity: Mask) -> None:
    """Bake the ambient occlusion into the vertex colors of a head's pieces; skin is the first.

    Hidden triangles of the teeth are removed, and teeth that are mostly hidden.

    ``layout`` (V, 3) are the skin's vertices on the reference head, dm. ``cavity`` (V,) are those
    that line the mouth.
    """
    solid = [p for p in pieces if p.name not in ("lashes", "brows", "tears")]
    offsets = np.cumsum([0] + [len(p.geometry.vertices) for p in solid])
    vertices = np.concatenate([_open_mouth_vertices(p) for p in solid])
    normals = np.concatenate([_outward(p) for p in solid])

    def visibility(with_hair: bool) -> Doubles:
        triangles = [
            p.geometry.triangles + first
            for p, first in zip(solid, offsets, strict=False)
            if with_hair or p.name != "hair"
        ]
        return openness(vertices, normals, np.concatenate(triangles))

    # strands let some light through
    seen = 0.5 * visibility(False) + 0.5 * visibility(True)
    for piece, first in zip(solid, offsets, strict=False):
        geometry = piece.geometry
        light = np.clip(seen[first : first + len(geometry.vertices)], 0, 1)[:, None]
        if piece.name == "skin":
            # the vertices behind the neckband are too sparse
            bare = np.clip((layout[:, 1:2] - neckline_height(layout[:, 2:]) - 0.02) / 0.22, 0, 1)
            light = bare * light + (1 - bare) * 0.55
            shaded = np.clip(0.10 + 1.0 * light, 0, 1) ** np.array([0.90, 1.0, 1.04])
            lining = np.array([0.55, 0.17, 0.16]) * _into_mouth(layout[:, 2])
            shaded = np.where(cavity[:, None], lining * (0.5 + 0.5 * shaded), shaded)
        elif piece.name == "garment":
            shaded = 0.6 + 0.4 * light
        elif piece.name.startswith("eye"):
            shaded = np.clip(
                0.95 - 2.2 * (geometry.vertices[:, 1:2] - geometry.vertices[0, 1] - 0.005) / 0.1,
                0.45,
                1.0,
            )
        elif piece.name == "hair":
            shaded = 0.40 + 0.60 * light
        elif piece.name.startswith("teeth"):
            shaded = (0.5 + 0.5 * np.clip(2 * light, 0, 1)) * _along_teeth(geometry)
        else:
            lit = np.clip(0.5 + 1.5 * light, 0, 1) * _into_mouth(geometry.vertices[:, 2] + 0.22)
            shaded = lit * np.array([1.0, 0.85, 0.85])
        geometry.colors = geometry.colors * shaded
        if piece.name.startswith("teeth"):
            visible = seen[first : first + len(geometry.vertices)] > _HIDDEN
            piece.keep(_visible_triangles(geometry.triangles, visible))


def _visible_triangles(triangles: Integers, visible: Mask) -> Mask:
    """Return which triangles (F,) of the teeth are visible, without fragments of hidden teeth."""
    edges = np.concatenate([triangles[:, :2], triangles[:, 1:]]).T
    graph = coo_array((np.ones(edges.shape[1]), edges), shape=(len(visible), len(visible)))
    tooth = connected_components(graph, directed=False)[1][triangles[:, 0]]
    shown = visible[triangles].any(axis=1)
    shown_fraction = np.bincount(tooth, shown) / np.maximum(np.bincount(tooth), 1)
    return np.asarray(shown & (shown_fraction[tooth] > _TOOTH_SHOWN))


def _outward(piece: HeadPiece) -> Doubles:
    """Return normals (V, 3). Normals of hair point away from the skull."""
    points = _open_mouth_vertices(piece)
    if piece.name != "hair":
        return subdivision.vertex_normals(points, piece.geometry.triangles)
    away = points - _SKULL
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def _along_teeth(geometry: Geometry) -> Doubles:
    """Return the fraction (V, 1) of the light on a row of teeth: less at the back and inside."""
    front = geometry.vertices[:, 2].max()
    back = (front - geometry.vertices[:, 2:]) / 0.45
    outward = (geometry.vertices - [0, 0, front - 0.4]) * [1, 0, 1]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normals = subdivision.vertex_normals(geometry.vertices, geometry.triangles)
    inside = np.clip(-1.5 * (normals * outward).sum(axis=1, keepdims=True), 0, 1)
    return np.asarray(np.clip(1.15 - 2.2 * back, 0.05, 1.0) * (1 - 0.75 * inside))


def _into_mouth(z: Doubles) -> Doubles:
    """Return the fraction (V, 1) of the light at a depth behind the lips."""
    inside = np.clip((z[:, None] - 0.75) / 0.5, 0, 1)
    return 0.02 + 0.98 * inside**2
