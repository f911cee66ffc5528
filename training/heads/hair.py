"""Hair: an opaque body near the scalp, and locks laid over it like tapes.

Both follow a sheet that leads from the roots (a parting, or a whorl) to the tips. Hair is made on
the reference head (see ``assemble``) and warped onto each head with its skin. All lengths are
MakeHuman decimetres, y up, z towards the viewer, x to the subject's left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, ndimage

from kouxing.training.heads.parts import Part, grid_triangles

Float = NDArray[np.float64]

_SKULL = np.array([0.0, 5.93, 0.42])
_CROWN = np.array([0.0, 0.97, -0.24])  # direction from the skull's middle in which hair whorls
NUM_BANDS = 5  # of the texture, side by side: the body's, then those that locks choose from
_MARGIN = 0.04  # of a band, which no lock shows
_BODY_TONE = 0.75  # of the opaque body, a factor on the texture
_LOCK_ROWS = 9  # odd: coarse locks use every second one


class Hair(Protocol):
    """A way to wear one's hair."""

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque body of the hair and the locks over it, over points (N, 3) of the skin.

        The parts' colours are factors on the texture.
        """
        ...

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Say how far into the hair points of the skin lie: 0 at the hairline, 1 well inside."""
        ...

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Say which points (N, 3) of the skin can never be seen."""
        ...

    def shaded(self, points: Float) -> Float:
        """Share (N,) of the hair's shadow that falls on points (N, 3) of the skin."""
        ...


# ---- sheets and locks -------------------------------------------------------------------------


class _Sheet:
    """A surface along which hair lies: a grid (A, S, 3) of points, across and along the hair."""

    def __init__(self, points: Float, middle: Float | None = None) -> None:
        if middle is not None:
            points = points + middle
        self.points = points
        across, along = np.gradient(points, axis=0), np.gradient(points, axis=1)
        normals = np.cross(across, along)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
        if middle is None:  # of a head, or of hair that hangs down round the neck
            middle = np.where(points[..., 1:2] > _SKULL[1], _SKULL, points * [0, 1, 0])
        away = points - middle
        self._turned = (normals * away).sum() < 0
        normals *= -1.0 if self._turned else 1.0
        self._layers = np.concatenate([points, normals], axis=2)

    def at(self, across: Float, along: Float) -> tuple[Float, Float]:
        """Points and outward directions (..., 3) at shares 0 to 1 of the grid."""
        size = np.array(self.points.shape[:2])[:, None] - 1
        place = np.stack([across.ravel(), along.ravel()]) * size
        found = np.stack(
            [
                ndimage.map_coordinates(self._layers[..., k], place, order=1, mode="nearest")
                for k in range(6)
            ],
            axis=1,
        ).reshape(*across.shape, 6)
        return found[..., :3], found[..., 3:]

    def body(self, shown: NDArray[np.bool_]) -> Part:
        """Make the opaque body of the quads (A - 1, S - 1) that are shown.

        The texture's first band lies on it again and again, mirrored each time.
        """
        rows, columns, _ = self.points.shape
        turn = np.abs((np.arange(rows) % 8) - 4) / 4
        u = (_MARGIN + (1 - 2 * _MARGIN) * turn) / NUM_BANDS
        v = np.linspace(0.0, 1.0, columns)
        uv = np.stack(np.broadcast_arrays(u[:, None], v[None, :]), axis=2).reshape(-1, 2)
        triangles = grid_triangles(rows, columns)[np.repeat(shown.ravel(), 2)]
        if self._turned:
            triangles = triangles[:, ::-1]
        used, compact = np.unique(triangles, return_inverse=True)
        vertices = self.points.reshape(-1, 3)[used]
        return Part(vertices, compact.reshape(-1, 3), uv[used], np.full((len(used), 3), _BODY_TONE))


@dataclass(slots=True)
class _Locks:
    """Locks over a sheet; every field but the last three is (N,)."""

    across: Float  # share of the sheet where it grows
    start: Float  # share along it of the root,
    end: Float  # and of the tip
    width: Float  # dm
    lift: Float  # of its middle above the sheet, dm
    drift: Float  # of the tip across, share of the sheet
    tip_width: float  # share of the width
    root_lift: float  # shares of the lift
    tip_lift: float

    def part(self, sheet: _Sheet, rng: np.random.Generator) -> Part:
        """Make three-sided tapes; the outer ones come last, so that they blend over the inner."""
        order = np.argsort(self.lift)
        own = [np.asarray(f)[order, None] for f in (
            self.across, self.start, self.end, self.width, self.lift, self.drift)]  # fmt: skip
        across, start, end, width, lift, drift = own
        t = np.linspace(0.0, 1.0, _LOCK_ROWS)[None, :]
        wave = 0.15 * width * np.sin(2.5 * t + rng.uniform(0, 6.28, (len(order), 1)))
        middle, out = sheet.at(across + drift * t**1.5, start + (end - start) * t)
        ahead = np.gradient(middle, axis=1)
        side = np.cross(ahead, out)
        side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-9)
        half_width = 0.5 * width * np.interp(t, [0, 0.2, 0.6, 1], [0.7, 1, 0.95, self.tip_width])
        rise = np.interp(t, [0, 0.35, 0.7, 1], [self.root_lift, 1, 1, self.tip_lift]) * lift
        middle = middle + rise[..., None] * out + wave[..., None] * side
        half = half_width[..., None] * side
        ridge = 0.22 * half_width[..., None] * out
        fall = 0.8 * rise[..., None] * out  # edges lie on the sheet, or light shines through below
        points = np.stack([middle - half - fall, middle + ridge, middle + half - fall], axis=2)
        band = rng.integers(1, NUM_BANDS, len(order))[:, None, None]
        share = _MARGIN + (1 - 2 * _MARGIN) * np.array([0, 0.5, 1.0])
        mirrored = np.where(rng.random(len(order)) < 0.5, 1, -1)[:, None, None]
        u = (band + 0.5 + mirrored * (share - 0.5)[None, None, :]) / NUM_BANDS
        u, v = np.broadcast_arrays(u, np.broadcast_to(t[:, :, None], (1, _LOCK_ROWS, 3)))
        one = grid_triangles(_LOCK_ROWS, 3)[:, ::-1]
        first = _LOCK_ROWS * 3 * np.arange(len(order))[:, None, None]
        tone = rng.uniform(0.76, 1.0, (len(order), 1))
        # what lies deeper is darker; roots have the body's tone
        tone *= np.interp(self.lift[order], [0, max(self.lift.max(), 1e-9)], [0.85, 1])[:, None]
        tone = _BODY_TONE + (tone - _BODY_TONE) * np.clip(t / 0.3, 0, 1)
        colors = np.repeat(tone.ravel(), 3)[:, None] * np.ones(3)
        return Part(
            points.reshape(-1, 3),
            (one[None] + first).reshape(-1, 3),
            np.stack([u, v], axis=-1).reshape(-1, 2),
            colors,
        )


def coarse_locks(count: int) -> NDArray[np.int64]:
    """Triangles (F, 3) of locks with ``count`` vertices that use every second row."""
    rows = np.arange(0, _LOCK_ROWS, 2)
    used = (3 * rows[:, None] + np.arange(3)).ravel()
    one = used[grid_triangles(len(rows), 3)[:, ::-1]]
    first = np.arange(0, count, 3 * _LOCK_ROWS)[:, None, None]
    return (one[None] + first).reshape(-1, 3)


def _joined(parts: list[Part]) -> Part:
    first = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Part(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + at for part, at in zip(parts, first, strict=False)]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )


# ---- bob --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Bob:
    """Long hair, parted.

    Attributes
    ----------
    parting
        Azimuth of the parting, degrees to the subject's left.
    length
        From the ears to the tips, dm.
    turn_in
        How far the tips turn towards the neck, dm.
    """

    parting: float = 14.0
    length: float = 1.06
    turn_in: float = 0.17

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque body of the hair and the locks over it."""
        bodies, locks = [], []
        rng = np.random.default_rng(1)
        for side in (1.0, -1.0):
            sheet = _Sheet(self._side(side, 26, 26))
            across, along = np.meshgrid(np.arange(25) / 25, np.arange(25) / 25, indexing="ij")
            bodies.append(sheet.body((across >= 0.03) & (along < 0.97)))
            count = 36
            roots = np.concatenate([rng.uniform(0.02, 1, count), rng.uniform(0, 0.07, 12)])
            front = roots < 0.10
            count = len(roots)
            locks.append(
                _Locks(
                    across=roots,
                    start=np.where(front, 0.0, rng.uniform(0.0, 0.06, count)),
                    end=rng.uniform(0.975, 1.01, count),
                    width=rng.uniform(0.08, 0.18, count) * np.where(front, 0.7, 1),
                    lift=rng.uniform(0.006, 0.034, count),
                    drift=rng.normal(0, 0.02, count),
                    tip_width=0.75,
                    root_lift=0.0,
                    tip_lift=0.6,
                ).part(sheet, rng)
            )
        return {"hair": _joined(bodies), "hair_tips": _joined(locks)}

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Say how far into the hair points of the skin lie."""
        height = np.interp(
            x,
            [0.0, 0.15, 0.30, 0.42, 0.52, 0.60, 0.66, 0.72],
            [6.40, 6.40, 6.37, 6.32, 6.21, 6.04, 5.80, 5.55],
        )
        behind = (np.arctan2(x, z - 0.35) > 1.75) & (y > 5.1)
        return np.where(behind, 2.0, (y - height) / 0.13)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Say which points of the skin can never be seen."""
        _, y, z = points.T
        return np.asarray((y > 6.60) | ((z < 0.0) & (y > 5.25)))

    def shaded(self, points: Float) -> Float:
        """Share of the hair's shadow: ears and sides of the neck."""
        return np.clip((0.66 - points[:, 2]) / 0.12, 0, 1)

    def _side(self, side: float, strands: int, steps: int) -> Float:
        """Comb one side from the parting over the ear down: points (strands, rows, 3).

        ``side`` is 1 for the subject's left, -1 for the right.
        """
        across = np.linspace(0.0, 1.0, strands)
        parting = side * self.parting * np.interp(across, [0, 0.6, 1], [1.0, 0.6, 0.0])
        # directions from the skull's centre, by azimuth from the front and elevation, degrees:
        # along the parting over the crown, half-way down, and above the ears; behind, the two
        # sides overlap
        azimuth = np.interp(across, [0.0, 0.25, 1.0], [60.0, 84.0, 183.0])
        halfway = np.interp(across, [0.0, 0.3, 1.0], [44.0, 80.0, 183.0]) + 0.4 * parting
        ways = [
            _way(parting, np.interp(across, [0, 0.35, 1], [34.0, 65.0, 112.0])),
            _way(halfway, np.interp(across, [0.0, 0.3, 1.0], [31.0, 62.0, 40.0])),
            _way(azimuth, np.full(strands, -6.0)),
        ]
        on_skull = np.linspace(0.0, 1.0, 2 * steps // 3 + 1)
        skull = _bezier(np.stack(ways), on_skull)
        skull /= np.linalg.norm(skull, axis=2, keepdims=True)
        # hair stands up beside the parting
        swell = 1.0 + 0.035 * np.sin(np.pi * (0.15 + 0.85 * on_skull**0.7))[None, :, None]
        skull *= np.array([side * 0.745, 0.925, 0.90]) * swell
        skull[..., 2] *= np.where(skull[..., 2] > 0, 1.035, 1.0)  # over the forehead
        skull += _SKULL

        # below the ears the hair hangs and turns inwards at the tips
        drop = np.linspace(0.0, 1.0, steps - 2 * steps // 3)[1:]
        length = self.length * np.interp(across, [0.0, 0.15, 0.5, 1.0], [0.96, 1.02, 1.04, 1.0])
        last, before = skull[:, -1], skull[:, -2]
        lean = last - before
        lean /= np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
        facing = np.radians(azimuth)
        out = np.stack([side * np.sin(facing), np.zeros(strands), np.cos(facing)], axis=1)
        sway = 0.05 * np.sin(np.pi * np.minimum(drop * 0.9, 1)) - self.turn_in * drop**3
        hang = (
            last[:, None]
            - length[:, None, None] * drop[None, :, None] * np.array([0.0, 1.0, 0.0])
            + out[:, None] * sway[None, :, None]
        )
        hang += 0.04 * (lean * [1, 0, 1])[:, None] * drop[None, :, None]
        points = np.concatenate([skull, hang], axis=1)
        # lie over the ear
        low = np.clip((6.35 - points[..., 1]) / 0.70, 0, 1)
        low = low * low * (3 - 2 * low)
        aside = np.exp(-(((azimuth[:, None] - 97) / 30) ** 2))
        points += (0.10 * low * aside)[..., None] * out[:, None]
        # below the cheekbone the front edge keeps to the face
        hug = np.exp(-((across / 0.10) ** 2))[:, None]
        hug = hug * np.clip((5.62 - points[..., 1]) / 0.25, 0, 1)
        points[..., 0] -= side * 0.05 * hug
        return points


def _way(azimuth: Float, elevation: Float) -> Float:
    """Directions (A, 3) by azimuth from the front towards x, and elevation, degrees."""
    turn, up = np.radians(azimuth), np.radians(elevation)
    return np.stack([np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)], axis=1)


def _bezier(points: Float, t: Float) -> Float:
    """Evaluate quadratic curves with control points (3, A, 3) at (T,) as (A, T, 3)."""
    first, middle, last = points[:, :, None, :]
    s = t[None, :, None]
    curve: Float = (1 - s) ** 2 * first + 2 * s * (1 - s) * middle + s**2 * last
    return curve


# ---- short cuts -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Crop:
    """Short hair that grows from a whorl to the hairline, or is combed back from the forehead.

    Attributes
    ----------
    hairline
        Points (N, 3) of the left half from the middle of the forehead over the ear to the nape.
    heights, thickness
        Thickness of the hair by height on the head, both in dm.
    ends
        Share of the thickness that is left at the hairline: 0 for cropped hair, more for a fringe.
    combed_back
        Azimuth up to which hair is combed back, rad; 0: nowhere.
    aside
        How far it is combed to the subject's left, rad.
    locks, length, width
        Their number, and their length and breadth in dm.
    lift
        How far the locks stand off, dm.
    bun
        Radius of a bun behind the whorl, dm; 0: none.
    """

    hairline: tuple[tuple[float, float, float], ...]
    heights: tuple[float, ...]
    thickness: tuple[float, ...]
    ends: float = 0.0
    combed_back: float = 0.0
    aside: float = 0.0
    locks: int = 270
    length: float = 0.42
    width: float = 0.10
    lift: float = 0.03
    bun: float = 0.0

    def _share(self, points: Float) -> tuple[Float, Float, Float]:
        """Azimuth about the whorl (0 in front to pi), angle from it, and that of the hairline."""
        azimuth, polar = _about_crown(points)
        line_azimuth, line_polar = _about_crown(np.array(self.hairline))
        order = np.argsort(line_azimuth)
        line = interpolate.PchipInterpolator(line_azimuth[order], line_polar[order])
        low, high = line_azimuth.min(), line_azimuth.max()
        return azimuth, polar, line(np.clip(azimuth, low, high))

    def _sheet(self, scalp: Float) -> tuple[_Sheet, Float]:
        """Lay a sheet from the whorl to the hairline; also its length along each turn (A,), dm."""
        rows, columns = 61, 22
        turn = np.linspace(-np.pi, np.pi, rows)
        share = np.linspace(0.0, 1.0, columns)
        line = self._share(_SKULL + _direction(turn, np.full(rows, 1.2)))[2]
        turns, polar = np.broadcast_arrays(turn[:, None], share[None, :] * line[:, None])
        direction = _direction(turns.ravel(), polar.ravel())
        base = _SKULL + direction * _radius(scalp, direction)[:, None]
        t = np.tile(share, rows)
        height = np.interp(base[:, 1], self.heights, self.thickness)
        edge = np.clip((1.0 - t) / 0.22, 0, 1)
        height *= self.ends + (1 - self.ends) * np.sin(edge * np.pi / 2)
        points = base + direction * (0.010 + height)[:, None]
        points[:, 1] -= 0.10 * self.ends * np.clip(t - 0.7, 0, 1)
        return _Sheet(points.reshape(rows, columns, 3)), 0.78 * line

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque body of the hair and the locks over it."""
        rng = np.random.default_rng(3)
        sheet, reach = self._sheet(scalp)
        along = np.tile(np.arange(21) / 21, (60, 1))
        body = sheet.body(along < 0.93)
        count = self.locks
        turn = rng.uniform(-np.pi, np.pi, count)
        line = np.interp(turn, np.linspace(-np.pi, np.pi, len(reach)), reach)
        length = self.length * rng.uniform(0.75, 1.25, count) / line
        # as many to an area: the whorl has little of it
        root = np.sqrt(rng.uniform(0.0, 1.0, count))
        start = np.clip(root - 0.45 * length, 0.0, 0.92)
        end = np.minimum(start + length, rng.uniform(0.93, 1.0, count))
        back = np.abs(turn) < self.combed_back * rng.uniform(0.85, 1.15, count)
        front = back & (root > 0.80)  # the hairline itself is dense
        root = np.where(front, rng.uniform(0.93, 1.0, count), root)
        start, end = (
            np.where(back, np.clip(root, 0.3, 1.0), start),
            np.where(back, np.clip(root - 1.2 * length, 0.04, 0.9), end),
        )
        combed = self.aside * np.clip(1.6 - np.abs(turn), 0, 1)
        low = np.clip(1.3 - (start + end) / 2, 0.3, 1)  # close to the skin at temples and nape
        locks = _Locks(
            across=turn / (2 * np.pi) + 0.5,
            start=start,
            end=end,
            width=self.width
            * rng.uniform(0.7, 1.4, count)
            * np.where(front, 0.8, np.interp(end, [0.8, 1], [1.1, 0.75])),
            lift=self.lift * rng.uniform(0.25, 1.0, count) * np.where(back, 1.0, low),
            drift=combed / (2 * np.pi) + rng.normal(0, 0.012, count),
            tip_width=0.3,
            root_lift=0.0,
            tip_lift=0.5,
        )
        tips = locks.part(sheet, rng)
        if self.bun:
            body = _joined([body, _bun(self.bun, rng)])
        return {"hair": body, "hair_tips": tips}

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Say how far into the hair points of the skin lie."""
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        _, polar, line = self._share(points)
        # a fringe hangs over bare skin
        return ((line - polar - 0.5 * self.ends) * 0.75 / 0.10).reshape(x.shape)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Say which points of the skin can never be seen."""
        _, polar, line = self._share(points)
        return np.asarray(polar < 0.70 * line) & (np.abs(points[:, 0]) < 0.60)

    def shaded(self, points: Float) -> Float:
        """Share of the hair's shadow: what lies under it, and a little below."""
        _, polar, line = self._share(points)
        return 0.5 * np.clip((line - polar) / 0.2 + 0.6, 0, 1)


def _bun(radius: float, rng: np.random.Generator) -> Part:
    """Make a bun of curls, a bumpy ball behind the whorl."""
    rows, columns = 41, 24
    turn = np.linspace(0, 2 * np.pi, rows)[:, None]
    polar = np.linspace(0.02, np.pi - 0.02, columns)[None, :]
    bumps = ndimage.gaussian_filter(rng.standard_normal((rows - 1, columns)), 0.9, mode="wrap")
    bumps = np.vstack([bumps, bumps[:1]]) / bumps.std()
    size = radius * (1 + 0.05 * bumps * np.sin(polar))
    ball = size[..., None] * np.stack(
        [
            np.sin(polar) * np.cos(turn),
            np.broadcast_to(0.85 * np.cos(polar), (rows, columns)),
            np.sin(polar) * np.sin(turn),
        ],
        axis=2,
    )
    behind = np.array([0.0, 0.80, -0.60])
    return _Sheet(ball, _SKULL + behind * (0.86 + 0.45 * radius)).body(
        np.ones((rows - 1, columns - 1), dtype=bool)
    )


def _direction(azimuth: Float, polar: Float) -> Float:
    """Directions (N, 3) by the azimuth from the front and the angle from the whorl."""
    up = _CROWN / np.linalg.norm(_CROWN)
    side = np.array([1.0, 0.0, 0.0])
    front = np.cross(side, up)
    around = np.cos(azimuth)[:, None] * front + np.sin(azimuth)[:, None] * side
    direction: Float = np.cos(polar)[:, None] * up + np.sin(polar)[:, None] * around
    return direction


def _about_crown(points: Float) -> tuple[Float, Float]:
    """Azimuth from the front (0 to pi, both sides alike) and angle from the whorl, each (N,)."""
    up = _CROWN / np.linalg.norm(_CROWN)
    front = np.cross([1.0, 0.0, 0.0], up)
    away = points - _SKULL
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    return np.arctan2(np.abs(away[:, 0]), away @ front), np.arccos(np.clip(away @ up, -1, 1))


def _radius(scalp: Float, direction: Float) -> Float:
    """Distance (N,) of the skull's surface from its middle in given directions, ears left out."""
    x, y, z = scalp.T
    ear = (np.abs(x) > 0.60) & (y > 5.3) & (y < 6.0) & (z > -0.05) & (z < 0.62)
    kept = (y > 4.95) & ~ear & ((z < 1.0) | (y > 5.95))
    away = scalp[kept] - _SKULL
    length = np.linalg.norm(away, axis=1)
    surface = interpolate.RBFInterpolator(
        away / length[:, None], length, neighbors=24, smoothing=1e-3, kernel="linear"
    )
    radius: Float = surface(direction)
    return radius
