"""Ambient occlusion: how much of the sky each vertex sees, from many depth pictures.

H. Landis, "Production-ready global illumination", SIGGRAPH course 16, 2002.
"""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from services.driver.render import standalone_context

Float = NDArray[np.float64]

_SIZE = 512
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


def openness(
    vertices: Float, normals: Float, triangles: NDArray[np.int64], directions: int = 160
) -> Float:
    """Estimate the cosine-weighted share of the sphere of directions that each vertex sees.

    Parameters
    ----------
    vertices, normals
        Points to judge (V, 3), dm; only triangles between them hide.
    triangles
        What hides (F, 3).
    directions
        Number of depth pictures.

    Returns
    -------
    0 (closed in) to 1 (open), (V,).
    """
    index = np.arange(directions) + 0.5  # Fibonacci's lattice on the sphere
    polar, turn = np.arccos(1 - 2 * index / directions), np.pi * (1 + 5**0.5) * index
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
    picture = context.texture((_SIZE, _SIZE), 1, dtype="f4")
    target = context.framebuffer([picture], context.depth_renderbuffer((_SIZE, _SIZE)))
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
        depth = np.frombuffer(picture.read(), "f4").reshape(_SIZE, _SIZE)
        # lift the points off their own triangles
        place = (vertices + 0.012 * normals - middle) @ axes.T
        column = np.clip(((place[:, 0] + 1) / 2 * _SIZE).astype(int), 0, _SIZE - 1)
        row = np.clip(((place[:, 1] + 1) / 2 * _SIZE).astype(int), 0, _SIZE - 1)
        visible = (place[:, 2] + 1) / 2 <= depth[row, column] + 0.0015
        cosine = np.maximum(normals @ way, 0.0)
        seen += cosine * visible
        total += cosine
    context.release()
    return seen / np.maximum(total, 1e-9)
