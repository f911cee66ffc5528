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
    DIRECTION_AXES,
    INNER_LIPS,
    LOWER_LIP,
    OUTER_LIPS,
    UPPER_LIP,
    MouthFields,
    axis_field,
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
_HINGE_Z, _CHIN_Z = 0.35, 1.104  # positions of the jaw's axis and of the chin, dm


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
    triangles = subdivision.triangles_of(skin.quads)
    field = surface.smoothest_fields(skin.vertices, triangles, points, far)
    skin.vertices[:, 1] += field @ np.array(list(shifts.values()))


class FaceFields(MouthFields):
    """Computes all fields of the skin.

    ``cavity`` (V,) are the vertices that line the mouth. ``blink`` and ``squint`` are displacements
    (V, 3) of the face units of the left and the right eye. The fields are for FAPUs of 1 dm.
    """

    def __init__(
        self, skin: Skin, cavity: Mask, blink: list[Doubles], squint: list[Doubles]
    ) -> None:
        points = {name: int(skin.number[vertex]) for name, vertex in FEATURE_POINTS.items()}
        super().__init__(skin.vertices, subdivision.triangles_of(skin.quads), skin.quads, points)
        self.cavity = cavity
        self._lips()
        self._jaw()
        self._eyes(blink, squint)
        self._brows()
        self._zones()

    def _lips(self) -> None:
        x, y, z = self._vertices.T
        nose = (y > 5.325) & (np.abs(x) < 0.28) & ~self.cavity
        far = self._distance(*INNER_LIPS, *OUTER_LIPS) > 0.34
        below = (y < 4.87) & ~self.cavity
        self._add_lip_fields(far | nose | below | (self.cavity & (z < 1.08)))

    def _jaw(self) -> None:
        _, y, z = self._vertices.T
        outside = ~self.cavity
        upper = self._distance(*UPPER_LIP) <= 0.03
        lower = self._distance(*LOWER_LIP) <= 0.03
        chin = (self._distance("2.1", "2.10", "2.11", "2.12") <= 0.14) & outside
        floor = self.cavity & (y < 4.98) & (z > 0.8)
        roof = self.cavity & ((y > 5.3) | (z < 0.5))
        away = outside & ((y > 5.48) | (z < 0.30) | (y < 4.58) | ((y < 4.9) & (z < 0.62)))
        moving = np.flatnonzero((chin | lower | floor) & ~away)
        weight = self._geodesics.zone(moving, np.flatnonzero((upper | roof | away) & ~lower))
        lever = np.maximum(z - _HINGE_Z, 0) / (z[self._points["2.1"]] - _HINGE_Z)
        self._add_jaw_fields(weight, lever, lip_share=0.5)

    def _eyes(self, blink: list[Doubles], squint: list[Doubles]) -> None:
        for units, pairs in (
            (blink, ((19, "3.1"), (20, "3.2"))),
            (squint, ((21, "3.3"), (22, "3.4"))),
        ):
            for unit, (fap, name) in zip(units, pairs, strict=True):
                axis, sign = DIRECTION_AXES[FAPS[fap - 1].direction]
                travel = sign * unit[self._points[name], axis]
                self.fields[fap] = unit / travel

    def _brows(self) -> None:
        x, y, z = self._vertices.T
        fixed = (y < 5.87) | (y > 6.42) | (z < 0.75) | self.cavity

        def bars(*names: str) -> list[Integers]:
            """Group each point with the hairs above and below, so that a brow keeps its breadth."""
            groups = []
            for point in self._points_named(*names):
                near = (np.abs(x - x[point]) < 0.022) & (np.abs(y - y[point]) < 0.050) & (z > 0.75)
                groups.append(np.union1d(np.flatnonzero(near & (y > 5.90)), [point]))
            return groups

        raised = self._smoothest_fields(bars("4.1", "4.3", "4.5", "4.2", "4.4", "4.6"), fixed)
        for fap, weight in zip((31, 33, 35, 32, 34, 36), raised.T, strict=True):
            self._add_field(fap, weight)
        squeezed = self._smoothest_fields(bars("4.1", "4.2", "4.5", "4.6"), fixed)
        self._add_field(37, squeezed[:, 0])
        self._add_field(38, squeezed[:, 1])

    def _zones(self) -> None:
        chin = self._points_named("2.1", "8.2", "8.7", "8.8")
        nose = self._points_named("9.1", "9.2", "9.3", "9.4", "9.5", "9.15")
        lips = self._points_named(*INNER_LIPS, *OUTER_LIPS)
        self._zone(18, "2.10", 0.02, 0.26, chin)
        # a puffed cheek also comes forward, and a lifted one swells
        for fap, name, reach, forward in (
            (39, "5.1", 0.46, 0.5), (40, "5.2", 0.46, 0.5),
            (41, "5.3", 0.36, 0.25), (42, "5.4", 0.36, 0.25),
        ):  # fmt: skip
            weight = self._bump(name, reach)
            self._add_field(fap, weight)
            self.fields[fap][:, 2] = forward * weight
        for fap, name, core, reach in (
            (61, "9.1", 0.03, 0.16), (62, "9.2", 0.03, 0.16),
            (63, "9.3", 0.04, 0.22), (64, "9.3", 0.04, 0.22),
        ):  # fmt: skip
            others = np.setdiff1d(np.concatenate([nose, lips]), self._points_named(name))
            self._zone(fap, name, core, reach, others)
        for fap, name in ((65, "10.1"), (66, "10.2"), (67, "10.3"), (68, "10.4")):
            self._zone(fap, name, 0.06, 0.32, np.zeros(0, int))
        for fap, side in ((27, "l"), (28, "r")):
            names = ("3.1", "3.3", "3.7", "3.11") if side == "l" else ("3.2", "3.4", "3.8", "3.12")
            self._zone(fap, names, 0.05, 0.22, nose)

    def _bump(self, name: str, reach: float) -> Doubles:
        lids = ("3.3", "3.4", "3.7", "3.8", "3.11", "3.12")
        distance = self._distance(name)
        fixed = (distance > reach) | self.cavity | (self._vertices[:, 1] > 5.80)
        for others, margin in (
            (INNER_LIPS + OUTER_LIPS, 0.07),
            (("9.1", "9.2", "9.15"), 0.10),
            (lids, 0.07),
        ):
            fixed |= self._distance(*others) <= margin
        return self._smoothest_fields([np.flatnonzero(distance <= 0.08)], fixed)[:, 0]

    def _zone(
        self, fap: int, names: str | tuple[str, ...], core: float, reach: float, fixed: Integers
    ) -> None:
        """Move vertices within ``core`` of the points, fix those beyond ``reach``."""
        points = self._points_named(*([names] if isinstance(names, str) else names))
        near = self._geodesics.distance(points)
        moving = np.setdiff1d(np.flatnonzero(near <= core), fixed)
        all_fixed = np.union1d(np.flatnonzero(near > reach), fixed)
        self._add_field(fap, self._geodesics.zone(moving, all_fixed))


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
    fields = {fap: axis_field(fap, at_tip) * fapu[FAPS[fap - 1].fapu] for fap in (43, 44, 45)}
    fields[46] = axis_field(46, at_body) * fapu["MNS"]
    half = np.abs(tongue.vertices[edges, 0]).mean()
    roll = np.zeros_like(tongue.vertices)
    reach = np.clip((z - z.min()) / (0.5 * length), 0, 1)
    roll[:, 1] = reach * np.abs(x) * (np.abs(x) / half)  # lever times angle, growing outward
    fields[47] = roll
    forward = np.clip((z - z.min()) / (0.45 * length), 0, 1)
    return fields | jaw_fields(tongue.vertices, forward**2 * (3 - 2 * forward), fapu)


def jaw_fields(vertices: Doubles, weight: Doubles, fapu: dict[str, float]) -> Fields:
    """Compute the fields (V, 3) of parts that move with the jaw: lower teeth, tongue."""
    lever = weight * np.maximum(vertices[:, 2] - _HINGE_Z, 0) / (_CHIN_Z - _HINGE_Z)
    return {
        3: axis_field(3, lever) * fapu["MNS"],
        14: axis_field(14, weight) * fapu["MNS"],
        15: axis_field(15, lever) * fapu["MW"],
    }
