"""The built-in head as a user's mesh, without fields or with renamed shapes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.head.head import Head
from tests import heads
from tests.glb_writer import Mesh

ORIGINAL = heads.load("woman", "coarse")
OMITTED_PARTS = ("brows", "lashes")  # transparent parts that move, which these meshes omit


def meshes(shapes: Mapping[str, NDArray[Any]] | None = None) -> list[Mesh]:
    """Return the parts with morph targets, given as FAPs (68,) by name."""
    shown = [part for part in ORIGINAL.parts if not part.name.startswith(OMITTED_PARTS)]
    mesh_of = {
        part.name: Mesh(
            part.name,
            ORIGINAL.vertices[part.vertices],
            ORIGINAL.triangles[part.triangles].astype(np.int64) - part.vertices.start,
            uv=ORIGINAL.uv[part.vertices],
            colors=ORIGINAL.colors[part.vertices],
            texture=ORIGINAL.textures[part.texture],
        )
        for part in shown
    }
    for name, faps in (shapes or {}).items():
        shift = (ORIGINAL.basis @ np.asarray(faps, np.float32)).reshape(-1, 3)
        for part in shown:
            if np.abs(shift[part.vertices]).max() > 1e-6:
                mesh_of[part.name].targets[name] = shift[part.vertices]
    return list(mesh_of.values())


def write_obj(path: Path, parts: list[Mesh]) -> None:
    """Write vertices with colors and texture coordinates with a seam at x = 0."""
    lines, first = [], 1
    for part in parts:
        lines.append(f"o {part.name}")
        colors = np.ones_like(part.vertices) if part.colors is None else np.sqrt(part.colors)
        for row, color in zip(part.vertices, colors, strict=True):
            lines.append("v " + " ".join(f"{value:.6f}" for value in (*row, *color)))
        for side in (0, 1):
            lines += [f"vt {0.5 + x:.5f} {side}" for x in part.vertices[:, 0]]
        count = len(part.vertices)
        texture = 2 * (first - 1) + 1
        for corners in part.triangles:
            side = int(part.vertices[corners, 0].mean() > 0)
            words = [f"{first + v}/{texture + side * count + v}" for v in corners]
            lines.append("f " + " ".join(words))
        first += count
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def shape_error(head: Head, faps: NDArray[np.floating]) -> float:
    """Return the difference of the skins' displacements from the original's, relative to these."""
    shift, wanted = (
        (model.deform(np.asarray(faps, np.float32)) - model.vertices)[model.part("skin").vertices]
        / np.linalg.norm(model.eye_centers[0] - model.eye_centers[1])
        for model in (head, ORIGINAL)
    )
    return float(np.linalg.norm(shift - wanted) / np.linalg.norm(wanted))
