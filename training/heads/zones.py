"""Displacement fields of the FAPs over the skin, the tongue, the teeth and the eyes.

A field is the displacement, in dm, by its FAP at one FAPU (1024 FAP units; 1 rad for the roll of
the tongue). Along the FAP's axis, every feature point moves exactly as far as the FAP says. The
standard does not define the motion across it: corners of the mouth slide along the curve of the
lips, eyelids move around the eyeball, puffed cheeks come forward.

- Most FAPs move a zone whose weight falls as a raised cosine of the distances along the surface to
  the moving and to the fixed vertices (Li 2011, section 2.1; ``surface.Geodesics.zone``).
- Lips and brows have many adjacent feature points. Their field is the smoothest one (least squared
  Laplacian) that is 1 at its point, 0 at the other points and 0 around them, as in A. Jacobson et
  al., "Bounded biharmonic weights", SIGGRAPH 2011, but unbounded.
- Eyelids follow MakeHuman's face units eyeBlink and eyeSquint, scaled to their feature points.
- The jaw's motion at the lips' feature points is subtracted from FAPs 3, 14 and 15.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from kouxing.services.driver.head import surface
from kouxing.services.driver.head.skin_fields import (
    CORNER_SLOPE,
    DIRECTION_AXES,
    INNER_LIPS,
    OUTER_LIPS,
)
from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.face.faps import FAPS
from kouxing.training.heads import subdivision
from kouxing.training.heads.makehuman import FEATURE_POINTS

Fields = dict[int, Doubles]  # FAP number -> (V, 3)

# the ring of vertices along which the lips meet, from 2.2 over 2.4 and 2.3 to 2.5
LIP_RING = (
    520, 7267, 7268, 7261, 7262, 11962, 7263, 7181, 7180, 7196, 10399, 7194, 7195, 10376, 7205,
    7206, 7266, 7265, 7264, 523, 517, 518, 519, 446, 445, 3708, 435, 434, 3731, 436, 420, 421, 516,
    5360, 515, 514, 522, 521,
)  # fmt: skip
_HINGE_Z = 0.35  # position of the jaw's axis, dm


@dataclass(slots=True)
class Skin:
    """A subdivided surface; a coarse vertex keeps its number in the fine one."""

    number: Integers  # number of a base mesh vertex on the surface, or -1
    coarse_quads: Integers
    quads: Integers
    matrix: sparse.csr_array  # coarse vertices -> fine vertices
    vertices: Doubles  # fine, dm
    base: Integers  # base mesh vertex of each coarse vertex

    def transfer(self, target: Doubles) -> Doubles:
        """Transfer displacements (19158, 3) of the base mesh to the fine vertices."""
        return np.asarray(self.matrix @ target[self.base])

    def point(self, name: str) -> int:
        """Find the vertex of a feature point."""
        return int(self.number[FEATURE_POINTS[name]])

    def points(self, *names: str) -> Integers:
        """Find the vertices of feature points."""
        return self.number[[FEATURE_POINTS[name] for name in names]]


def subdivide(vertices: Doubles, quads: Integers) -> Skin:
    """Subdivide some quads of the base mesh once."""
    base, compact = np.unique(quads, return_inverse=True)
    coarse = compact.reshape(quads.shape)
    number = np.full(len(vertices), -1)
    number[base] = np.arange(len(base))
    matrix, fine = subdivision.catmull_clark(coarse, len(base))
    return Skin(number, coarse, fine, matrix, matrix @ vertices[base], base)


def close_lips(skin: Skin, overlap: float = 0.002) -> None:
    """Move both lips so that they meet along the whole ring, and overlap by ``overlap`` dm.

    Subdivision rounds the lips off, which would leave a slit.
    """
    ring = skin.number[np.array(LIP_RING)]
    corner = int(np.argmax(skin.vertices[ring, 0]))
    upper = np.r_[ring[-corner:], ring[: corner + 1]]
    lower = ring[corner : len(ring) - corner + 1]
    height = []
    for half in (upper, lower):
        order = np.argsort(skin.vertices[half, 0])
        height.append(skin.vertices[half[order]][:, :2].T)
    shifts = {}
    for half, sign in ((upper, -1.0), (lower, 1.0)):
        for vertex in half:
            vertex_x = skin.vertices[vertex, 0]
            up, low = (np.interp(vertex_x, *curve) for curve in height)
            shifts[int(vertex)] = (up + low) / 2 + sign * overlap - skin.vertices[vertex, 1]
    for vertex in (ring[corner], ring[-corner]):
        shifts[int(vertex)] = 0.0
    points = np.array(list(shifts))
    far = surface.Geodesics(skin.vertices, skin.quads).distance(points) > 0.10
    field = smoothest_fields(skin, points, np.flatnonzero(far))
    skin.vertices[:, 1] += field @ np.array(list(shifts.values()))


def axis_of(fap: int) -> tuple[int, float]:
    """Return axis (0 x, 1 y, 2 z) and sign of a displacement FAP."""
    return DIRECTION_AXES[FAPS[fap - 1].direction]


def smoothest_fields(skin: Skin, points: Integers | list[Integers], fixed: Integers) -> Doubles:
    """Interpolate between points of the skin, see ``surface.smoothest_fields``."""
    return surface.smoothest_fields(
        skin.vertices, subdivision.triangles_of(skin.quads), points, fixed
    )


def _axis_field(fap: int, weight: Doubles) -> Doubles:
    """Make a field (V, 3) along the axis of a FAP."""
    axis, sign = axis_of(fap)
    field = np.zeros((len(weight), 3))
    field[:, axis] = sign * weight
    return field


class FaceFields:
    """Computes all fields of the skin.

    ``cavity`` (V,) are the vertices that line the mouth. ``blink`` and ``squint`` are displacements
    (V, 3) of the face units of the left and the right eye. The fields are for FAPUs of 1 dm.
    """

    def __init__(
        self, skin: Skin, cavity: Mask, blink: list[Doubles], squint: list[Doubles]
    ) -> None:
        self.skin = skin
        self.cavity = cavity
        self.fields: Fields = {}
        self._geodesics = surface.Geodesics(skin.vertices, skin.quads)
        self._lips()
        self._jaw()
        self._eyes(blink, squint)
        self._brows()
        self._zones()

    def _add(self, fap: int, weight: Doubles) -> None:
        self.fields[fap] = _axis_field(fap, weight)

    def _far(self, names: tuple[str, ...], reach: float) -> Mask:
        return self._geodesics.distance(self.skin.points(*names)) > reach

    def _lips(self) -> None:
        skin = self.skin
        x, y, z = skin.vertices.T
        nose = (y > 5.325) & (np.abs(x) < 0.28) & ~self.cavity
        outside = self._far(INNER_LIPS + OUTER_LIPS, 0.34) | nose | ((y < 4.87) & ~self.cavity)
        fixed = np.flatnonzero(outside | (self.cavity & (z < 1.08)))
        names = INNER_LIPS + OUTER_LIPS
        points = skin.points(*names)
        fixed = np.setdiff1d(fixed, points)
        self.lip_y = dict(zip(names, smoothest_fields(skin, points, fixed).T, strict=True))
        for fap, name in (
            (4, "2.2"), (5, "2.3"), (8, "2.6"), (9, "2.7"), (10, "2.8"), (11, "2.9"),
            (12, "2.4"), (13, "2.5"), (51, "8.1"), (52, "8.2"), (55, "8.5"), (56, "8.6"),
            (57, "8.7"), (58, "8.8"), (59, "8.3"), (60, "8.4"),
        ):  # fmt: skip
            self._add(fap, self.lip_y[name])
        # points halfway to a corner follow it by half, so that a narrowed mouth keeps its shape
        corners = ("2.4", "2.5", "8.3", "8.4")
        halfway = (("2.6", "2.8"), ("2.7", "2.9"), ("8.5", "8.7"), ("8.6", "8.8"))
        middles = ("2.2", "2.3", "8.1", "8.2")
        between = tuple(name for pair in halfway for name in pair)
        single = smoothest_fields(skin, skin.points(*corners, *between, *middles), fixed)
        self.lip_x = {}
        for row, (fap, name) in enumerate(((6, "2.4"), (7, "2.5"), (53, "8.3"), (54, "8.4"))):
            half = single[:, 4 + 2 * row : 6 + 2 * row].sum(axis=1)
            self.lip_x[name] = single[:, row] + 0.45 * half
            self._add(fap, self.lip_x[name])
            # a corner slides along the curve of the lips, outward and backward
            self.fields[fap][:, 2] = -CORNER_SLOPE * self.lip_x[name]
        pushed = smoothest_fields(skin, skin.points("2.3", "2.2", *corners), fixed)[:, :2]
        self.lip_z = dict(zip(("2.3", "2.2"), pushed.T, strict=True))
        self._add(16, self.lip_z["2.3"])
        self._add(17, self.lip_z["2.2"])

    def _jaw(self) -> None:
        skin = self.skin
        _, y, z = skin.vertices.T
        outside = ~self.cavity
        upper = ~self._far(("2.2", "2.6", "2.7", "8.1", "8.5", "8.6"), 0.03)
        lower = ~self._far(("2.3", "2.8", "2.9", "8.2", "8.7", "8.8"), 0.03)
        chin = ~self._far(("2.1", "2.10", "2.11", "2.12"), 0.14) & outside
        floor = self.cavity & (y < 4.98) & (z > 0.8)
        roof = self.cavity & ((y > 5.3) | (z < 0.5))
        away = outside & ((y > 5.48) | (z < 0.30) | (y < 4.58) | ((y < 4.9) & (z < 0.62)))
        moving = np.flatnonzero((chin | lower | floor) & ~away)
        self.jaw = self._geodesics.zone(moving, np.flatnonzero((upper | roof | away) & ~lower))
        lever = np.maximum(z - _HINGE_Z, 0) / (skin.vertices[skin.point("2.1"), 2] - _HINGE_Z)
        for fap, weight, subtracted in (
            (3, self.jaw * lever, self.lip_y),
            (14, self.jaw, self.lip_z),
            (15, self.jaw * lever, self.lip_x),
        ):
            left = weight / weight[skin.point("2.1")]
            for name, field in subtracted.items():
                left = left - left[skin.point(name)] * field
            if fap == 15:  # the lower lip follows the jaw half
                for name in ("2.3", "2.8", "2.9", "8.2", "8.7", "8.8"):
                    left = left - 0.5 * left[skin.point(name)] * self.lip_y[name]
            self._add(fap, left)

    def _eyes(self, blink: list[Doubles], squint: list[Doubles]) -> None:
        for units, pairs in (
            (blink, ((19, "3.1"), (20, "3.2"))),
            (squint, ((21, "3.3"), (22, "3.4"))),
        ):
            for unit, (fap, name) in zip(units, pairs, strict=True):
                axis, sign = axis_of(fap)
                travel = sign * unit[self.skin.point(name), axis]
                self.fields[fap] = unit / travel

    def _brows(self) -> None:
        x, y, z = self.skin.vertices.T
        fixed = np.flatnonzero((y < 5.87) | (y > 6.42) | (z < 0.75) | self.cavity)

        def bars(*names: str) -> list[Integers]:
            """Group each point with the hairs above and below, so that a brow keeps its breadth."""
            groups = []
            for point in self.skin.points(*names):
                near = (np.abs(x - x[point]) < 0.022) & (np.abs(y - y[point]) < 0.050) & (z > 0.75)
                groups.append(np.union1d(np.flatnonzero(near & (y > 5.90)), [point]))
            return groups

        raised = smoothest_fields(self.skin, bars("4.1", "4.3", "4.5", "4.2", "4.4", "4.6"), fixed)
        for fap, weight in zip((31, 33, 35, 32, 34, 36), raised.T, strict=True):
            self._add(fap, weight)
        squeezed = smoothest_fields(self.skin, bars("4.1", "4.2", "4.5", "4.6"), fixed)
        self._add(37, squeezed[:, 0])
        self._add(38, squeezed[:, 1])

    def _zones(self) -> None:
        chin = self.skin.points("2.1", "8.2", "8.7", "8.8")
        nose = self.skin.points("9.1", "9.2", "9.3", "9.4", "9.5", "9.15")
        lips = np.concatenate([self.skin.points(*INNER_LIPS), self.skin.points(*OUTER_LIPS)])
        self._zone(18, "2.10", 0.02, 0.26, chin)
        # a puffed cheek also comes forward, and a lifted one swells
        for fap, name, reach, forward in (
            (39, "5.1", 0.46, 0.5), (40, "5.2", 0.46, 0.5),
            (41, "5.3", 0.36, 0.25), (42, "5.4", 0.36, 0.25),
        ):  # fmt: skip
            weight = self._bump(name, reach)
            self._add(fap, weight)
            self.fields[fap][:, 2] = forward * weight
        for fap, name in ((61, "9.1"), (62, "9.2")):
            others = np.setdiff1d(np.concatenate([nose, lips]), self.skin.points(name))
            self._zone(fap, name, 0.03, 0.16, others)
        others = np.setdiff1d(np.concatenate([lips, nose]), self.skin.points("9.3"))
        for fap in (63, 64):
            self._zone(fap, "9.3", 0.04, 0.22, others)
        for fap, name in ((65, "10.1"), (66, "10.2"), (67, "10.3"), (68, "10.4")):
            self._zone(fap, name, 0.06, 0.32, np.zeros(0, int))
        for fap, side in ((27, "l"), (28, "r")):
            names = ("3.1", "3.3", "3.7", "3.11") if side == "l" else ("3.2", "3.4", "3.8", "3.12")
            self._zone(fap, names, 0.05, 0.22, nose)

    def _bump(self, name: str, reach: float) -> Doubles:
        _, y, _ = self.skin.vertices.T
        lids = ("3.3", "3.4", "3.7", "3.8", "3.11", "3.12")
        fixed = self._far((name,), reach) | self.cavity | (y > 5.80)
        for others, margin in (
            (INNER_LIPS + OUTER_LIPS, 0.07),
            (("9.1", "9.2", "9.15"), 0.10),
            (lids, 0.07),
        ):
            fixed |= ~self._far(others, margin)
        top = np.flatnonzero(~self._far((name,), 0.08))
        return smoothest_fields(self.skin, [top], np.flatnonzero(fixed))[:, 0]

    def _zone(
        self, fap: int, names: str | tuple[str, ...], core: float, reach: float, fixed: Integers
    ) -> None:
        """Move vertices within ``core`` of the points, fix those beyond ``reach``."""
        points = self.skin.points(*([names] if isinstance(names, str) else names))
        near = self._geodesics.distance(points)
        moving = np.setdiff1d(np.flatnonzero(near <= core), fixed)
        all_fixed = np.union1d(np.flatnonzero(near > reach), fixed)
        self._add(fap, self._geodesics.zone(moving, all_fixed))


def tongue_fields(tongue: Skin, fapu: dict[str, float]) -> Fields:
    """Compute the fields (V, 3) of the tongue, including its fraction of the jaw's motion."""
    geodesics = surface.Geodesics(tongue.vertices, tongue.quads)
    tip, body = tongue.points("6.1"), tongue.points("6.2")
    edges = tongue.points("6.3", "6.4")
    x, _, z = tongue.vertices.T
    root = np.flatnonzero(z < z.min() + 0.12)
    length = z.max() - z.min()
    at_tip = geodesics.zone(tip, np.concatenate([body, root]))
    near = geodesics.distance(body)
    at_body = geodesics.zone(np.flatnonzero(near < 0.04), np.concatenate([tip, root]))
    fields = {fap: _axis_field(fap, at_tip) * fapu[FAPS[fap - 1].fapu] for fap in (43, 44, 45)}
    fields[46] = _axis_field(46, at_body) * fapu["MNS"]
    half = np.abs(tongue.vertices[edges, 0]).mean()
    roll = np.zeros_like(tongue.vertices)
    reach = np.clip((z - z.min()) / (0.5 * length), 0, 1)
    roll[:, 1] = reach * np.abs(x) * (np.abs(x) / half)  # lever times angle, growing outward
    fields[47] = roll
    forward = np.clip((z - z.min()) / (0.45 * length), 0, 1)
    return fields | jaw_fields(tongue.vertices, forward**2 * (3 - 2 * forward), fapu)


def jaw_fields(
    vertices: Doubles, weight: Doubles, fapu: dict[str, float], chin_z: float = 1.104
) -> Fields:
    """Compute the fields (V, 3) of parts that move with the jaw: lower teeth, tongue."""
    lever = weight * np.maximum(vertices[:, 2] - _HINGE_Z, 0) / (chin_z - _HINGE_Z)
    return {
        3: _axis_field(3, lever) * fapu["MNS"],
        14: _axis_field(14, weight) * fapu["MNS"],
        15: _axis_field(15, lever) * fapu["MW"],
    }
