"""Displacement fields of the FAPs on any face, computed from its feature points.

The built-in heads use the same constructions (``training.heads.zones``). Here all lengths are
relative to the face. Zones have weights that fall as a raised cosine of the surface distances to
the moving and fixed vertices (Li 2011, section 2.1). Lips, lids and brows use the smoothest field
that is 1 at its point and 0 at the other points.

A field is the displacement by one FAP unit, m. FAPs of missing points have no effect.
"""

from collections.abc import Mapping

import numpy as np

from kouxing.services.driver.head.mesh_pieces import FapFields
from kouxing.services.driver.head.surface import Geodesics, smoothest_fields
from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.face.faps import FAP_UNITS_PER_FAPU, FAPS, MOUTH_WIDTH_FAPS

INNER_LIPS = ("2.2", "2.6", "2.4", "2.8", "2.3", "2.9", "2.5", "2.7")
OUTER_LIPS = ("8.1", "8.5", "8.3", "8.7", "8.2", "8.8", "8.4", "8.6")
LOWER_LIP = ("2.3", "2.8", "2.9", "8.2", "8.7", "8.8")
UPPER_LIP = ("2.2", "2.6", "2.7", "8.1", "8.5", "8.6")
DIRECTION_AXES = {
    "down": (1, -1.0), "up": (1, 1.0), "left": (0, 1.0), "right": (0, -1.0), "forward": (2, 1.0),
}  # fmt: skip
CORNER_SLOPE = 0.37  # slope of the lip curve near the corners, seen from above
_LID_SLOPE = 0.15  # a closing lid moves forward around the eyeball
_HINGE_DISTANCE = 1.34  # distance from the chin back to the jaw's axis, eye distances
# FAP, feature point, radius that moves as a whole, and reach, in eye distances
_ZONES = (
    (18, "2.10", 0.04, 0.47), (39, "5.1", 0.18, 0.72), (40, "5.2", 0.18, 0.72),
    (41, "5.3", 0.09, 0.54), (42, "5.4", 0.09, 0.54), (61, "9.1", 0.05, 0.29),
    (62, "9.2", 0.05, 0.29), (63, "9.3", 0.07, 0.40), (64, "9.3", 0.07, 0.40),
    (65, "10.1", 0.11, 0.58), (66, "10.2", 0.11, 0.58), (67, "10.3", 0.11, 0.58),
    (68, "10.4", 0.11, 0.58),
)  # fmt: skip
_FACE_POINTS = (
    *INNER_LIPS, *OUTER_LIPS, "2.1", "3.3", "3.4", "3.7", "3.8", "3.11", "3.12", "9.1", "9.2",
    "9.3", "9.4", "9.5", "9.15",
)  # fmt: skip


def axis_field(fap: int, weight: Doubles) -> Doubles:
    """Return a field (V, 3) along the axis of a FAP, in FAPUs."""
    axis, sign = DIRECTION_AXES[FAPS[fap - 1].direction]
    field = np.zeros((len(weight), 3))
    field[:, axis] = sign * weight
    return field


class MouthFields:
    """Makes the displacement fields of a skin's mouth, and stores all fields of the skin.

    ``points`` are the vertices of feature points, at least those in ``INNER_LIPS`` and
    ``OUTER_LIPS``, 2.1 and 2.10. Distances are along the edges of ``faces`` (F, 3 or 4).
    """

    def __init__(
        self, vertices: Doubles, triangles: Integers, faces: Integers, points: Mapping[str, int]
    ) -> None:
        self.fields: FapFields = {}
        self._vertices, self._triangles, self._points = vertices, triangles, points
        self._geodesics = Geodesics(vertices, faces)

    def _scaled(self, field: Doubles, _fap: int) -> Doubles:
        """Scale a field of a FAP from FAPUs to the unit of the fields, here the FAPU itself."""
        return field

    def _add_field(self, fap: int, weight: Doubles) -> None:
        self.fields[fap] = self._scaled(axis_field(fap, weight), fap)

    def _points_named(self, *names: str) -> Integers:
        return np.array([self._points[name] for name in names if name in self._points], np.int64)

    def _distance(self, *names: str) -> Doubles:
        return self._geodesics.distance(self._points_named(*names))

    def _smoothest_fields(self, points: Integers | list[Integers], fixed: Mask) -> Doubles:
        return smoothest_fields(self._vertices, self._triangles, points, fixed)

    def _add_lip_fields(self, fixed: Mask) -> None:
        """Add the FAPs of the lips, which do not move the ``fixed`` vertices (V,)."""
        names = INNER_LIPS + OUTER_LIPS
        raised = self._smoothest_fields(self._points_named(*names), fixed)
        self._lip_y = dict(zip(names, raised.T, strict=True))
        for fap in FAPS[2:]:
            if fap.direction in ("up", "down") and set(fap.feature_points) & set(names):
                self._add_field(fap.number, self._lip_y[fap.feature_points[0]])
        # points halfway to a corner move half as far, so that a narrow mouth keeps its shape
        corners = ("2.4", "2.5", "8.3", "8.4")
        between = ("2.6", "2.8", "2.7", "2.9", "8.5", "8.7", "8.6", "8.8")
        middles = ("2.2", "2.3", "8.1", "8.2")
        single = self._smoothest_fields(self._points_named(*corners, *between, *middles), fixed)
        self._lip_x = {}
        for row, (fap_x, name) in enumerate(zip(MOUTH_WIDTH_FAPS, corners, strict=True)):
            half = single[:, 4 + 2 * row : 6 + 2 * row].sum(axis=1)
            self._lip_x[name] = single[:, row] + 0.45 * half
            self._add_field(fap_x, self._lip_x[name])
            # a corner slides along the curve of the lips: outward motion is also backward
            self.fields[fap_x][:, 2] = self._scaled(-CORNER_SLOPE * self._lip_x[name], fap_x)
        pushed = self._smoothest_fields(self._points_named("2.3", "2.2", *corners), fixed)[:, :2]
        self._lip_z = dict(zip(("2.3", "2.2"), pushed.T, strict=True))
        self._add_field(16, self._lip_z["2.3"])
        self._add_field(17, self._lip_z["2.2"])

    def _add_jaw_fields(self, weight: Doubles, lever: Doubles, lip_share: float = 0.0) -> None:
        """Add the FAPs of the jaw without its motion at the lips' feature points.

        ``weight`` (V,) is how far a vertex follows the jaw, and ``lever`` (V,) how far a depth
        follows the jaw's rotation. The lower lip's height follows FAP 15 less by ``lip_share``.
        """
        for fap, motion, lip_weights in (
            (3, weight * lever, self._lip_y),
            (14, weight, self._lip_z),
            (15, weight * lever, self._lip_x),
        ):
            weights = motion / motion[self._points["2.1"]]
            for name, lip_weight in lip_weights.items():
                weights = weights - weights[self._points[name]] * lip_weight
            if fap == 15 and lip_share:
                for name in LOWER_LIP:
                    lowered = lip_share * weights[self._points[name]] * self._lip_y[name]
                    weights = weights - lowered
            self._add_field(fap, weights)


class SkinFields(MouthFields):
    """The displacement fields of a skin with vertices (V, 3), m, and triangles (F, 3).

    ``eyes`` are the centers of the left and right eye (2, 3), m.
    """

    def __init__(
        self,
        vertices: Doubles,
        triangles: Integers,
        points: dict[str, int],
        eyes: Doubles,
        fapu: dict[str, float],
    ) -> None:
        super().__init__(vertices, triangles, triangles, points)
        self._eyes, self._fapu = eyes, fapu
        self._unit = fapu["ES"]
        self._add_mouth_fields()
        self._add_lid_fields()
        self._add_brow_fields()
        self._add_zone_fields()

    def jaw_fields(self, vertices: Doubles) -> FapFields:
        """Return the fields (V, 3) of parts that move with the jaw: lower teeth, tongue."""
        lever = self._jaw_share(vertices[:, 2])
        full_weight = np.ones(len(vertices))
        moved = {3: lever, 14: full_weight, 15: lever}
        return {fap: self._scaled(axis_field(fap, weight), fap) for fap, weight in moved.items()}

    def tongue_fields(
        self, vertices: Doubles, rows: Integers, tip: int, body: int | None
    ) -> FapFields:
        """Return the fields (R, 3) of a tongue, ``rows`` (R,) of a mesh, without the jaw's motion.

        ``tip`` and ``body`` are the vertices of the points 6.1 and, if known, 6.2.
        """
        z = vertices[rows, 2]
        root = z.min()
        along = np.clip((z - root) / max(vertices[tip, 2] - root, 1e-9), 0, 1)
        middle = 0.5 if body is None else (vertices[body, 2] - root) / (vertices[tip, 2] - root)
        beyond = np.clip((along - middle) / max(1 - middle, 1e-9), 0, 1)
        at_tip = 0.5 - 0.5 * np.cos(np.pi * beyond)
        hump = 0.5 + 0.5 * np.cos(np.pi * np.clip((along - middle) / max(middle, 1e-9), -1, 0))
        moved = dict.fromkeys((43, 44, 45), at_tip) | {46: hump * (1 - at_tip)}
        return {fap: self._scaled(axis_field(fap, weight), fap) for fap, weight in moved.items()}

    def _point(self, name: str) -> Doubles:
        point: Doubles = self._vertices[self._points[name]]
        return point

    def _scaled(self, field: Doubles, fap: int) -> Doubles:
        return field * self._fapu[FAPS[fap - 1].fapu] / FAP_UNITS_PER_FAPU

    def _add_mouth_fields(self) -> None:
        x, y, z = self._vertices.T
        unit, width = self._unit, self._fapu["MW"]
        lips = self._point("2.2")
        # surfaces behind the lips: palate, inner cheeks, floor of the mouth
        self._behind = (np.abs(x - lips[0]) < 0.62 * width) & (z < lips[2] - 0.41 * unit)
        nose = (
            y > self._point("8.1")[1] + 0.75 * (lips[1] + self._fapu["MNS"] - self._point("8.1")[1])
        ) & (np.abs(x - lips[0]) < 0.6 * width)
        far = self._distance(*INNER_LIPS, *OUTER_LIPS) > 0.72 * width
        fixed = far | nose | (y < self._point("2.10")[1]) | self._behind
        self._add_lip_fields(fixed)
        self._add_jaw_fields(*self._jaw_motion())

    def _jaw_motion(self) -> tuple[Doubles, Doubles]:
        """Return how far each vertex follows the jaw, and how far depths follow its rotation."""
        _, y, z = self._vertices.T
        unit, lips, chin = self._unit, self._point("2.2"), self._point("2.1")
        inside = self._behind & (y > chin[1] + 0.1 * unit)
        upper = self._distance(*UPPER_LIP) < 0.055 * unit
        lower = self._distance(*LOWER_LIP) < 0.055 * unit
        below = (self._distance("2.1", "2.10", "2.11", "2.12") < 0.25 * unit) & ~inside
        floor = inside & (y < lips[1] - 0.33 * unit) & (z > lips[2] - 0.91 * unit)
        roof = inside & ((y > lips[1] + 0.24 * unit) | (z < lips[2] - 1.45 * unit))
        throat = (y < chin[1] + 0.17 * unit) & (z < chin[2] - 0.86 * unit)
        away = (y > lips[1] + 0.56 * unit) | (z < chin[2] - 1.43 * unit)
        away |= (y < chin[1] - 0.40 * unit) | throat
        away &= ~inside
        moving = np.flatnonzero((below | lower | floor) & ~away & ~upper)
        weight = self._geodesics.zone(moving, np.flatnonzero((upper | roof | away) & ~lower))
        return weight, self._jaw_share(z)

    def _jaw_share(self, z: Doubles) -> Doubles:
        """Return how far a depth follows the jaw rotation, 1 at the chin."""
        chin = self._point("2.1")[2]
        lever: Doubles = np.maximum(z - chin + _HINGE_DISTANCE * self._unit, 0) / (
            _HINGE_DISTANCE * self._unit
        )
        return lever

    def _add_lid_fields(self) -> None:
        for upper, lower, corners, faps in (
            ("3.1", "3.3", ("3.7", "3.11"), (19, 21)),
            ("3.2", "3.4", ("3.8", "3.12"), (20, 22)),
        ):
            names = [name for name in (upper, lower) if name in self._points]
            if names:
                far = self._distance(*names) > 0.45 * self._unit
                points = self._points_named(*names, *corners)
                weights = self._smoothest_fields(points, far)
                for name, weight in zip(names, weights.T, strict=False):
                    fap = faps[0] if name == upper else faps[1]
                    self._add_field(fap, weight)
                    self.fields[fap][:, 2] = np.abs(self.fields[fap][:, 1]) * _LID_SLOPE

    def _add_brow_fields(self) -> None:
        eyes, y = self._eyes.mean(axis=0)[1], self._vertices[:, 1]
        faps = {"4.1": 31, "4.2": 32, "4.3": 33, "4.4": 34, "4.5": 35, "4.6": 36}
        names = [name for name in faps if name in self._points]
        if not names:
            return
        fixed = (y < eyes + 0.17 * self._unit) | (y > eyes + 1.13 * self._unit)
        fixed |= self._distance(*names) > 0.9 * self._unit
        for name, weight in zip(
            names, self._smoothest_fields(self._points_named(*names), fixed).T, strict=True
        ):
            self._add_field(faps[name], weight)
        if {"4.1", "4.2"} <= set(names):
            ends = self._points_named("4.1", "4.2", "4.5", "4.6")
            squeezed = self._smoothest_fields(ends, fixed)
            self._add_field(37, squeezed[:, 0])
            self._add_field(38, squeezed[:, 1])

    def _add_zone_fields(self) -> None:
        for fap, name, core, reach in _ZONES:
            if name in self._points:
                # a zone ends at the other points of the face
                others = [other for other in _FACE_POINTS if other != name]
                distance = self._distance(name)
                fixed = np.union1d(
                    np.flatnonzero(distance > reach * self._unit), self._points_named(*others)
                )
                moving = np.setdiff1d(np.flatnonzero(distance <= core * self._unit), fixed)
                moving = np.union1d(moving, self._points_named(name))
                self._add_field(fap, self._geodesics.zone(moving, np.setdiff1d(fixed, moving)))
                if name in ("5.1", "5.2"):  # a puffed cheek also moves forward
                    self.fields[fap][:, 2] = 0.5 * np.abs(self.fields[fap][:, 0])
