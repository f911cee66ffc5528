"""A head: a mesh and a linear basis of facial animation parameters.

Every FAP except the rotations is a displacement field over the vertices, so a face is

    v(f) = v_0 + sum_k f_k * B_k

followed by the rotations of the eyeballs (FAPs 23 to 26) and of the head (FAPs 48 to 50).

======  ===========================================  =====  ==============
symbol  meaning                                      unit   shape
======  ===========================================  =====  ==============
v_0     vertices of the neutral face                 m      (V, 3)
f       facial animation parameters                  FAP    (68,)
B       displacement by one FAP unit                 m      (68, V, 3)
======  ===========================================  =====  ==============

Sources: ISO/IEC 14496-2 annex C (FAPs, FAPUs, feature points); Li 2011, section 2.1 (zones of
influence around feature points). Deviation: zone weights use distances along the surface, and the
lips between feature points are interpolated smoothly (biharmonic), see ``training.heads``.

Axes: x to the subject's left, y up, z to the front; the origin is the pivot of the head.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from kouxing.services.driver.head.normal_updater import NormalUpdater
from kouxing.services.heads import DEFAULT_HEAD, HEAD_NAMES
from kouxing.shared.arrays import Floats, Integers
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.files.array_file import read_arrays
from kouxing.shared.files.user_file import check_content

FORMAT = "kouxing head 1"
ASSETS = Path(__file__).parent / "assets"
MAX_BYTES = 512 * 1024 * 1024  # unpacked size of a file

Detail = Literal["fine", "coarse"]


@dataclass(frozen=True, slots=True)
class HeadPart:
    """A range of vertices and triangles with one material."""

    name: str
    vertices: slice  # rows of Head.vertices
    triangles: slice  # rows of Head.triangles
    texture: str  # key of Head.textures
    roughness: float  # 0 to 1
    transparent: bool  # the texture has alpha
    double_sided: bool  # the inside is visible


@dataclass(frozen=True, slots=True)
class Head:
    """A head with V vertices and F triangles that FAPs move."""

    name: str
    parts: tuple[HeadPart, ...]  # skin, garment, eyes, teeth, tongue, hair, lashes
    vertices: Floats  # (V, 3), neutral face, m
    triangles: NDArray[np.uint32]  # (F, 3), counter-clockwise from outside
    coarse_triangles: tuple[NDArray[np.uint32], ...]  # per part of the coarse head, (C, 3)
    uv: Floats  # (V, 2), v downwards
    colors: Floats  # (V, 3), linear factors on the texture: ambient occlusion and tint
    head_weight: Floats  # (V,), fraction of the head rotation, 0 on the shoulders
    basis: sparse.csr_array  # (3 V, 68), displacement by one FAP unit, m
    fapu: dict[str, float]  # MNS MW ENS ES IRISD in m, AU in rad
    feature_points: dict[str, int]  # vertex by point name, such as "2.1"
    eye_centers: Floats  # (2, 3), left and right, m
    textures: dict[str, bytes]  # encoded JPEG or PNG by name
    normal_updater: NormalUpdater
    cel: bool = False  # cartoon shading with one light and one dark tone

    @property
    def normals(self) -> Floats:
        """Unit normals of the neutral face (V, 3)."""
        return self.normal_updater.rest

    @classmethod
    def load(cls, path: str | Path = DEFAULT_HEAD, detail: Detail = "fine") -> Head:
        """Read a built-in head by its name, or a head from an ``.npz`` file.

        A "coarse" head has a quarter of the skin's triangles; feature points move equally.

        Raises ``UserError`` if the head does not exist, or the file is not a head.
        """
        file = Path(path)
        if file.suffix.lower() != ".npz":
            file = ASSETS / f"{path}.npz"
        if "\0" in str(path) or len(file.name) > 255 or not file.is_file():
            raise UserError(
                f"unknown head {str(path)!r}; use the path of a .glb, .gltf, .vrm or .npz, or one"
                f" of {', '.join(HEAD_NAMES)}"
            )
        expected = "a head; make one with kouxing head import"
        with check_content(file, expected):
            return assemble_head(file.stem, read_arrays(file, MAX_BYTES, expected), detail)

    def part(self, name: str) -> HeadPart:
        """Return a part by name."""
        return next(part for part in self.parts if part.name == name)

    def deform(self, faps: Floats) -> Floats:
        """Return the vertices (V, 3), m, moved by FAPs (68,); FAPs 1 and 2 are ignored."""
        return self._rotate(self._displace(faps), faps, self.eye_centers)

    def pose(self, faps: Floats) -> tuple[Floats, Floats]:
        """Return the vertices moved by FAPs (68,), and their normals, both (V, 3)."""
        vertices = self._displace(faps)
        normals = self.normal_updater.normals(vertices)
        no_centers = np.zeros_like(self.eye_centers)  # normals have no position
        return (
            self._rotate(vertices, faps, self.eye_centers),
            self._rotate(normals, faps, no_centers),
        )

    def _displace(self, faps: Floats) -> Floats:
        if faps.shape != (NUM_FAPS,):
            raise ValueError(f"expected FAPs of shape ({NUM_FAPS},), got {faps.shape}")
        moved: Floats = self.basis @ np.asarray(faps, dtype=np.float32)
        return self.vertices + moved.reshape(-1, 3)

    def _rotate(self, rows: Floats, faps: Floats, eye_centers: Floats) -> Floats:
        """Rotate eyeballs and head in place; ``rows`` are vertices or normals (V, 3)."""
        angle = np.asarray(faps, dtype=np.float64) * RADIANS_PER_ANGLE_UNIT
        for side, (name, yaw, pitch) in enumerate((("eye_left", 23, 25), ("eye_right", 24, 26))):
            if angle[yaw - 1] or angle[pitch - 1]:
                rotation = _rotation(angle[yaw - 1], angle[pitch - 1], 0.0)
                center = eye_centers[side]
                for part in self.parts:  # an eye may have several parts, or no part
                    if part.name.startswith(name):
                        selected = part.vertices
                        rows[selected] = (rows[selected] - center) @ rotation.T + center
        pitch, yaw, roll = angle[47:50]
        if pitch or yaw or roll:
            rotated = rows @ _rotation(yaw, pitch, roll).T
            rows += self.head_weight[:, None] * (rotated - rows)
        return rows


def _rotation(yaw: float, pitch: float, roll: float) -> Floats:
    """Return the matrix (3, 3) of yaw (left), pitch (down) and roll (right)."""
    rotation = Rotation.from_euler("YXZ", [yaw, pitch, roll])
    return np.asarray(rotation.as_matrix(), dtype=np.float32)


def assemble_head(
    name: str, arrays: dict[str, NDArray[np.generic]], detail: Detail = "fine"
) -> Head:
    """Build a head from the arrays of its file.

    Raises ``ValueError``, ``KeyError`` or ``IndexError`` if the arrays are not consistent.
    """
    if str(arrays["format"]) != FORMAT:
        raise ValueError(f"format {arrays['format']}, expected {FORMAT}")
    _check_arrays(arrays)
    coarse = detail == "coarse"
    # coarse vertices come first in each part, so the coarse head is a selection of rows
    first, after_coarse, after = arrays["part_vertices"].astype(np.int64).T
    ends = after_coarse if coarse else after
    used = np.concatenate([np.arange(a, b) for a, b in zip(first, ends, strict=True)])
    new_index = np.full(int(after[-1]), -1, dtype=np.int64)
    new_index[used] = np.arange(len(used))

    parts, triangles, coarse_triangles = [], [], []
    num_triangles = 0
    bounds = arrays["part_triangles"].astype(np.int64)  # fine start and end, coarse start and end
    for row, part_name in enumerate(arrays["part_names"].astype(str)):
        fine_part, coarse_part = (
            new_index[arrays["triangles"][start:end].astype(np.int64)]
            for start, end in (bounds[row, :2], bounds[row, 2:])
        )
        part_triangles = coarse_part if coarse else fine_part
        if len(part_triangles) == 0 or len(coarse_part) == 0 or part_triangles.min() < 0:
            raise ValueError(f"part {part_name} refers to missing vertices")
        triangles.append(part_triangles.astype(np.uint32))
        coarse_triangles.append(coarse_part.astype(np.uint32))
        from_vertex = int(new_index[first[row]])
        parts.append(
            HeadPart(
                name=str(part_name),
                vertices=slice(from_vertex, from_vertex + int(ends[row] - first[row])),
                triangles=slice(num_triangles, num_triangles + len(part_triangles)),
                texture=str(arrays["part_textures"][row]),
                roughness=float(arrays["part_roughness"].astype(float)[row]),
                transparent=bool(arrays["part_transparent"][row]),
                double_sided=bool(arrays["part_double_sided"][row]),
            )
        )
        num_triangles += len(part_triangles)

    faces = np.concatenate(triangles)
    vertices = arrays["vertices"].astype(np.float32)[used]
    basis = _basis(arrays, new_index, len(used))
    welds = new_index[arrays["welds"].astype(np.int64)[used]] if "welds" in arrays else None
    normal_updater = NormalUpdater.of(vertices, faces, basis, welds)
    return Head(
        name=name,
        parts=tuple(parts),
        vertices=vertices,
        normal_updater=normal_updater,
        triangles=faces,
        coarse_triangles=tuple(coarse_triangles),
        uv=arrays["uv"].astype(np.float32)[used] / np.float32(65535),
        colors=(arrays["colors"].astype(np.float32)[used] / np.float32(255)) ** 2,
        head_weight=arrays["head_weight"].astype(np.float32)[used] / np.float32(255),
        basis=basis,
        fapu=_by_name(arrays["fapu_names"], arrays["fapu"].astype(float)),
        feature_points=_by_name(
            arrays["feature_point_names"], new_index[arrays["feature_points"].astype(np.int64)]
        ),
        eye_centers=arrays["eye_centres"].astype(np.float32),
        textures={
            key.removeprefix("texture_"): value.astype(np.uint8).tobytes()
            for key, value in arrays.items()
            if key.startswith("texture_")
        },
        cel=bool(arrays.get("cel", False)),
    )


def _by_name(names: NDArray[Any], values: NDArray[Any]) -> dict[str, Any]:
    return dict(zip(names.astype(str).tolist(), values.tolist(), strict=True))


def _check_arrays(arrays: dict[str, NDArray[np.generic]]) -> None:
    """Check the arrays as far as later steps do not."""
    count, num_parts = len(arrays["vertices"]), len(arrays["part_names"])
    for key, shape in (
        ("vertices", (count, 3)), ("uv", (count, 2)), ("colors", (count, 3)),
        ("head_weight", (count,)), ("eye_centres", (2, 3)), ("part_vertices", (num_parts, 3)),
        ("part_triangles", (num_parts, 4)), ("part_textures", (num_parts,)),
        ("triangles", (len(arrays["triangles"]), 3)),
    ):  # fmt: skip
        if arrays[key].shape != shape:
            raise ValueError(f"{key} has shape {arrays[key].shape}, expected {shape}")
    first, after_coarse, after = arrays["part_vertices"].astype(np.int64).T
    if not (
        np.array_equal(np.append(first, count), np.append(0, after))
        and (first <= after_coarse).all()
        and (after_coarse <= after).all()
    ):
        raise ValueError("the parts do not cover the vertices exactly once")
    if len(set(arrays["part_names"].tolist())) < num_parts:
        raise ValueError("two parts have the same name")
    missing = {f"texture_{name}" for name in arrays["part_textures"].tolist()} - arrays.keys()
    if missing:
        raise ValueError(f"{', '.join(sorted(missing))} is missing")
    left, right = arrays["eye_centres"].astype(np.float64)
    if not (np.isfinite(arrays["vertices"].astype(np.float32)).all() and left[0] > right[0]):
        raise ValueError("a vertex is not finite, or the eyes are swapped")


def _basis(
    arrays: dict[str, NDArray[np.generic]], new_index: Integers, num_vertices: int
) -> sparse.csr_array:
    """Return the displacement fields as a sparse matrix (3 V, 68)."""
    bounds = arrays["field_bounds"].astype(np.int64)
    column = np.repeat(arrays["field_faps"].astype(np.int64) - 1, np.diff(bounds))
    unit = np.repeat(arrays["field_units"].astype(np.float64), np.diff(bounds))
    vertex = new_index[arrays["field_vertices"].astype(np.int64)]
    shift = arrays["field_shifts"].astype(np.float64) / unit[:, None]
    is_kept = vertex >= 0
    rows = (3 * vertex[is_kept, None] + np.arange(3)).ravel()
    basis = sparse.csr_array(
        (shift[is_kept].ravel().astype(np.float32), (rows, np.repeat(column[is_kept], 3))),
        (3 * num_vertices, NUM_FAPS),
    )
    if not np.isfinite(basis.data).all():
        raise ValueError("a displacement is not finite")
    return basis
