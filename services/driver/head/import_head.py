"""Builds a head from a mesh and its feature points.

The connected surface that contains point 8.1 is the skin; it gets the fields of ``skin_fields``.
The role of other connected surfaces follows from their position. Eyeballs rotate. Objects in the
mouth below the lips (lower teeth, tongue) follow the jaw. Objects on the skin (lashes, brows,
beard) follow the skin. The rest only follows the head.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from kouxing.services.driver.head.feature_points_file import FeaturePoints, read_points
from kouxing.services.driver.head.glb_head import EYE_DISTANCE_M, PIVOT_OFFSET, head_weight_at
from kouxing.services.driver.head.mesh_file import numbered_vertices, read_mesh
from kouxing.services.driver.head.mesh_pieces import FapFields, MeshPiece, pack_head, weld
from kouxing.services.driver.head.skin_fields import (
    INNER_LIPS,
    LOWER_LIP,
    OUTER_LIPS,
    UPPER_LIP,
    SkinFields,
)
from kouxing.services.driver.head.surface import Geodesics
from kouxing.shared.arrays import Doubles, Integers
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, RADIANS_PER_ANGLE_UNIT
from kouxing.shared.files.output_file import open_output

MAX_VERTICES = 65_535  # limit of 16-bit indices in the page's GLB
REQUIRED_POINTS = ("2.1", *sorted(INNER_LIPS), "2.10", *sorted(OUTER_LIPS))
_MOVED_POINTS = {name for fap in FAPS for name in fap.feature_points}
_MAX_SNAP = 0.15  # maximum distance of a point from the mesh, eye distances
_OFF_SURFACE = ("3.5", "3.6", "7.1", "3.13", "3.14")  # points that are not on the surface


def import_head(mesh: Path, points: Path, output: Path) -> list[str]:
    """Write a head (``.npz``) made from a mesh and its feature points.

    The mesh is a face at rest with a closed mouth; y is up. Returns warnings for the user about
    parts that will not move.

    Raises ``UserError`` if a file cannot be read or written, or the mesh and points are not a face.
    """
    if output.suffix.lower() != ".npz":
        raise UserError(f"{output}: use a name that ends in .npz")
    pieces = read_mesh(mesh)
    count = sum(len(piece.vertices) for piece in pieces)
    if count > MAX_VERTICES:
        raise UserError(f"{mesh} has {count} vertices; reduce it to at most {MAX_VERTICES}")
    feature_points = read_points(points)
    positions = _positions(mesh, points, pieces, feature_points)
    arrays, warnings = _HeadImport(mesh, points, pieces, positions, feature_points).run()
    with open_output(output) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    return warnings


def _positions(
    mesh: Path, path: Path, pieces: list[MeshPiece], points: FeaturePoints
) -> dict[str, Doubles]:
    """Return the coordinates of every point in the mesh's own axes."""
    vertices, named = numbered_vertices(mesh, pieces)
    positions = {}
    for name, position in points.positions.items():
        if isinstance(position, np.ndarray):
            positions[name] = position
        else:
            mesh_name, number = position
            candidates = named.get(mesh_name, vertices)
            if number >= len(candidates):
                raise UserError(
                    f"{path}: {name} is vertex {number}, but the last vertex is"
                    f" {len(candidates) - 1}; vertices count from 0"
                )
            positions[name] = candidates[number]
    return positions


class _HeadImport:
    """Builds the arrays of one head."""

    def __init__(
        self,
        mesh: Path,
        path: Path,
        pieces: list[MeshPiece],
        positions: dict[str, Doubles],
        feature_points: FeaturePoints,
    ) -> None:
        self._mesh, self._path, self._pieces = mesh, path, pieces
        self._warnings: list[str] = []
        self._stated_fapu = feature_points.fapu
        self._align_axes(positions)
        self._weld_vertices()
        self._snap_points(positions)

    def run(self) -> tuple[dict[str, NDArray[np.generic]], list[str]]:
        """Return the arrays of the head's file, and warnings."""
        fapu = self._measure_fapu()
        skin, local, inside = self._skin
        points = {name: int(local[v]) for name, v in self._points.items() if local[v] >= 0}
        face = SkinFields(self._welded[skin], inside, points, self._eyes, fapu)
        fields, roles = self._assign_fields(face, fapu)
        pieces, rows = self._split_eyeballs(roles)
        order = np.concatenate(rows)
        new_index = np.empty(len(order), np.int64)
        new_index[order] = np.arange(len(order))
        first_of = {int(w): int(v) for v, w in reversed(list(enumerate(self._weld_of)))}
        self._check_movements(fields, points)
        height = (self._vertices[order, 1] - self._eyes.mean(axis=0)[1]) / EYE_DISTANCE_M
        arrays = pack_head(
            pieces,
            fields=[{fap: field[selected] for fap, field in fields.items()} for selected in rows],
            head_weight=head_weight_at(height),
            fapu=fapu | {"AU": RADIANS_PER_ANGLE_UNIT},
            feature_points={
                name: int(new_index[first_of[vertex]]) for name, vertex in self._points.items()
            },
            eye_centers=self._eyes,
        )
        return arrays, self._warnings

    def _points_error(self, text: str) -> UserError:
        return UserError(f"{self._path}: {text}")

    # --- the mesh in the axes of a head ---------------------------------------------------------

    def _align_axes(self, positions: dict[str, Doubles]) -> None:
        eyes = {}
        for name, lids in (("3.5", ("3.1", "3.3")), ("3.6", ("3.2", "3.4"))):
            if name in positions:
                eyes[name] = positions[name]
            elif all(lid in positions for lid in lids):
                eyes[name] = (positions[lids[0]] + positions[lids[1]]) / 2
        missing = [name for name in REQUIRED_POINTS if name not in positions]
        missing += [f"{name} (or its eyelids)" for name in ("3.5", "3.6") if name not in eyes]
        if "9.15" not in positions and "MNS" not in self._stated_fapu:
            missing.append("9.15")
        if missing:
            raise self._points_error(f"points are missing: {', '.join(missing)}")
        left, right = eyes["3.5"], eyes["3.6"]
        middle, unit = (left + right) / 2, float(np.linalg.norm(left - right))
        down = middle - positions["2.1"]
        sideways = left - right
        if unit == 0 or down[1] < 0.8 * np.linalg.norm(down) or abs(sideways[0]) < 0.8 * unit:
            raise self._points_error(
                "the chin (2.1) is not below the eyes (3.5, 3.6); rotate the mesh so that y is up"
                " and the face looks along z"
            )
        turn = np.array([1.0, 1.0, 1.0]) if sideways[0] > 0 else np.array([-1.0, 1.0, -1.0])
        pivot = positions.get("7.1", middle + PIVOT_OFFSET * turn * unit)
        scale = EYE_DISTANCE_M / unit
        self._pivot, self._turn, self._scale = pivot, turn, scale
        self._eyes = self._to_head(np.stack([left, right]))
        for piece in self._pieces:
            piece.vertices = self._to_head(piece.vertices)
        self._vertices = np.concatenate([piece.vertices for piece in self._pieces])

    def _to_head(self, rows: Doubles) -> Doubles:
        turned: Doubles = (rows - self._pivot) * self._turn * self._scale
        return turned

    def _weld_vertices(self) -> None:
        """Merge vertices with the same position, and find the connected surfaces."""
        first = np.cumsum([0] + [len(piece.vertices) for piece in self._pieces])
        uv = np.concatenate([piece.uv for piece in self._pieces])
        flat = np.ptp(uv, axis=0).max() == 0  # slits are visible only in texture coordinates
        same = weld(self._vertices, np.arange(len(uv))[:, None] if flat else uv)
        _, self._weld_of = np.unique(same, return_inverse=True)
        count = int(self._weld_of.max()) + 1
        self._welded = np.zeros((count, 3))
        self._welded[self._weld_of] = self._vertices
        triangles = np.concatenate(
            [p.triangles + offset for p, offset in zip(self._pieces, first, strict=False)]
        )
        triangles = self._weld_of[triangles]
        a, b, c = triangles.T
        self._triangles: Integers = triangles[(a != b) & (b != c) & (c != a)]
        if not len(self._triangles):
            raise UserError(f"all faces of {self._mesh} have zero area; export the mesh again")
        edges = np.concatenate([self._triangles[:, [0, 1]], self._triangles[:, [1, 2]]])
        graph = sparse.coo_array((np.ones(len(edges)), edges.T), (count, count))
        _, self._component = csgraph.connected_components(graph, directed=False)

    def _snap_points(self, positions: dict[str, Doubles]) -> None:
        """Find the vertex of each point."""
        used = np.unique(self._triangles)
        tree = cKDTree(self._welded[used])
        self._points: dict[str, int] = {}
        off = []
        for name, position in positions.items():
            distance, row = tree.query(self._to_head(position))
            if name in _OFF_SURFACE:
                continue
            if distance <= _MAX_SNAP * EYE_DISTANCE_M:
                self._points[name] = int(used[row])
            elif name in _MOVED_POINTS or name in REQUIRED_POINTS:
                off.append(f"{name} by {distance / self._scale:.3g}")
        if off:
            raise self._points_error(
                f"points are too far from the mesh, in units of the mesh: {', '.join(off)}"
            )
        skin = np.flatnonzero(self._component == self._component[self._points["8.1"]])
        local = np.full(len(self._welded), -1)
        local[skin] = np.arange(len(skin))
        inside = local[self._triangles]
        self._skin = skin, local, inside[(inside >= 0).all(axis=1)]
        self._separate_lips(positions)
        lips = {name: self._points[name] for name in (*INNER_LIPS, *OUTER_LIPS, "2.1", "2.10")}
        apart = [name for name, vertex in lips.items() if local[vertex] < 0]
        if apart:
            raise self._points_error(
                f"{', '.join(apart)} and 8.1 are on separate meshes; join the meshes"
            )
        name_of_vertex: dict[int, str] = {}
        for name, vertex in lips.items():
            if vertex in name_of_vertex:
                raise self._points_error(
                    f"{name_of_vertex[vertex]} and {name} have the same vertex; separate them"
                )
            name_of_vertex[vertex] = name

    def _separate_lips(self, positions: dict[str, Doubles]) -> None:
        """Move inner points of closed lips to the correct lip."""
        skin, local, inside = self._skin
        if local[self._points["8.2"]] < 0:
            return
        geodesics = Geodesics(self._welded[skin], inside)
        to_upper, to_lower = (
            geodesics.distance(local[[self._points[name]]]) for name in ("8.1", "8.2")
        )
        tree = cKDTree(self._welded[skin])
        for name in (*UPPER_LIP[:3], *LOWER_LIP[:3]):
            here = self._to_head(positions[name])
            near = np.array(tree.query_ball_point(here, 0.05 * EYE_DISTANCE_M), dtype=np.int64)
            this_lip, other_lip = (
                (to_upper, to_lower) if name in UPPER_LIP else (to_lower, to_upper)
            )
            near = near[this_lip[near] < other_lip[near]]
            if len(near):
                best = near[np.argmin(np.linalg.norm(self._welded[skin[near]] - here, axis=1))]
                self._points[name] = int(skin[best])

    # --- what moves -----------------------------------------------------------------------------

    def _measure_fapu(self) -> dict[str, float]:
        """Return the FAPUs, m."""

        def height(name: str) -> float:
            return float(self._welded[self._points[name], 1])

        stated = {name: length * self._scale for name, length in self._stated_fapu.items()}
        eyes, points = float(self._eyes.mean(axis=0)[1]), self._points
        corners = self._welded[[points["8.3"], points["8.4"]], 0]
        nose = height("9.15") if "9.15" in points else height("2.2") + stated["MNS"]
        fapu = {
            "MNS": nose - height("2.2"),
            "MW": float(corners[0] - corners[1]),
            "ENS": eyes - nose,
            "ES": EYE_DISTANCE_M,
            "IRISD": height("3.1") - height("3.3") if {"3.1", "3.3"} <= set(points) else 0.0,
        }
        if fapu["IRISD"] <= 0:
            fapu["IRISD"] = stated.get("IRISD", 0.163 * EYE_DISTANCE_M)
        wrong = [name for name, length in fapu.items() if length <= 0]
        if wrong:
            raise self._points_error(
                f"{', '.join(wrong)} is not positive: left and right, or upper and lower points,"
                " are swapped (left is the subject's left, at positive x)"
            )
        return fapu

    def _assign_fields(
        self, face: SkinFields, fapu: dict[str, float]
    ) -> tuple[FapFields, NDArray[np.int8]]:
        """Return the fields (V, 3), and per vertex 1 (left eye), 2 (right eye) or 0."""
        skin = self._skin[0]
        fields = {fap: np.zeros_like(self._welded) for fap in face.fields}
        for fap, field in face.fields.items():
            fields[fap][skin] = field
        roles = np.zeros(len(self._welded), np.int8)
        tree = cKDTree(self._welded[skin])
        for component in range(int(self._component.max()) + 1):
            rows = np.flatnonzero(self._component == component)
            if component == self._component[skin[0]] or len(rows) < 3:
                continue
            low, high = self._welded[rows].min(axis=0), self._welded[rows].max(axis=0)
            middle = (low + high) / 2
            if eye := self._eye_of(middle, high - low):
                roles[rows] = eye
                self._eyes[eye - 1] = middle
                thrust = np.tile([0.0, 0.0, fapu["ES"] / FAP_UNITS_PER_FAPU], (len(rows), 1))
                fields.setdefault(26 + eye, np.zeros_like(self._welded))[rows] = thrust
            elif self._is_in_mouth(low, high, fapu):
                for fap, field in self._mouth_fields(face, component, rows, middle).items():
                    fields.setdefault(fap, np.zeros_like(self._welded))[rows] = field
            else:  # such as hair and lashes: they follow the nearest skin
                distance, nearest = tree.query(self._welded[rows])
                weight = np.clip(1 - distance / (0.25 * fapu["ES"]), 0, 1)[:, None]
                for fap, field in face.fields.items():
                    fields[fap][rows] = weight * field[nearest]
        if (roles == 0).all():
            self._warnings.append("no eyeballs separate from the skin: the eyes do not rotate")
        return {fap: field[self._weld_of] for fap, field in fields.items()}, roles[self._weld_of]

    def _is_in_mouth(self, low: Doubles, high: Doubles, fapu: dict[str, float]) -> bool:
        """Return whether an object with these corners is behind the lips: teeth or a tongue."""
        chin, lips = (self._welded[self._points[name]] for name in ("2.1", "2.2"))
        is_in_middle = np.abs((low[0] + high[0]) / 2 - lips[0]) < 0.6 * fapu["MW"]
        is_narrow = high[0] - low[0] < 1.5 * fapu["MW"]
        is_at_height = low[1] > chin[1] and high[1] < lips[1] + 1.5 * fapu["MNS"]
        is_behind = low[2] > lips[2] - 1.8 * fapu["ES"] and high[2] < lips[2] + 0.1 * fapu["ES"]
        return bool(is_in_middle and is_narrow and is_at_height and is_behind)

    def _mouth_fields(
        self, face: SkinFields, component: int, rows: Integers, middle: Doubles
    ) -> FapFields:
        """Return the fields of an object in the mouth; the upper teeth have none."""
        tip, body = (self._points.get(name) for name in ("6.1", "6.2"))
        fields: FapFields = {}
        if tip is not None and self._component[tip] == component:
            fields = face.tongue_fields(self._welded, rows, tip, body)
        if fields or middle[1] < self._welded[self._points["2.2"]][1]:
            fields |= face.jaw_fields(self._welded[rows])
        return fields

    def _eye_of(self, middle: Doubles, size: Doubles) -> int:
        """Return 1 for the left eyeball, 2 for the right eyeball, 0 for other objects."""
        is_round = size.min() > 0.4 * size.max() and 0.1 < size.max() / EYE_DISTANCE_M < 0.9
        for number, eye in enumerate(self._eyes, start=1):
            if is_round and np.linalg.norm(middle - eye) < 0.35 * EYE_DISTANCE_M:
                return number
        return 0

    def _split_eyeballs(self, roles: NDArray[np.int8]) -> tuple[list[MeshPiece], list[Integers]]:
        """Split pieces so that each eyeball is separate; return them and their vertex rows."""
        pieces, rows = [], []
        first = 0
        for piece in self._pieces:
            piece_roles = roles[first : first + len(piece.vertices)]
            for role, name in ((0, piece.name), (1, "eye_left"), (2, "eye_right")):
                used = np.flatnonzero(piece_roles == role)
                shown = (piece_roles[piece.triangles] == role).all(axis=1)
                if not shown.any():
                    continue
                number = np.full(len(piece_roles), -1)
                number[used] = np.arange(len(used))
                pieces.append(
                    replace(
                        piece,
                        name=name,
                        vertices=piece.vertices[used],
                        triangles=number[piece.triangles[shown]],
                        uv=piece.uv[used],
                        colors=piece.colors[used],
                    )
                )
                rows.append(used + first)
            first += len(piece_roles)
        return pieces, rows

    def _check_movements(self, fields: FapFields, points: dict[str, int]) -> None:
        still = [
            fap.name
            for fap in FAPS[2:]
            if fap.number not in fields and fap.fapu != "AU" and fap.number not in (27, 28)
        ]
        if still:
            self._warnings.append(
                f"no points for these FAPs, so they have no effect: {', '.join(still)}"
            )
        skin, _, inside = self._skin
        along = Geodesics(self._welded[skin], inside).distance(np.array([points["2.2"]]))
        if along[points["2.3"]] < 0.05 * EYE_DISTANCE_M:
            self._warnings.append(
                "the lips are joined between 2.2 and 2.3, so the mouth cannot open; cut it open"
            )
