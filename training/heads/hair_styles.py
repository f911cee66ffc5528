"""The ways to wear hair: a bob and short cuts.

A style makes its parts over points (N, 3) of the skin of the reference head: ``hair``, the opaque
body, and ``hair_tips``, the locks. The colors of a part are factors on its texture.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, ndimage

from kouxing.training.heads.hair import SKULL, Locks, Sheet, join
from kouxing.training.heads.parts import Geometry

Float = NDArray[np.float64]

_CROWN = np.array([0.0, 0.97, -0.24])  # direction of the whorl from the skull's center


@dataclass(frozen=True, slots=True)
class Bob:
    """Long, parted hair."""

    parting: float = 14.0  # azimuth, degrees to the subject's left
    length: float = 1.06  # from the ears to the tips, dm
    turn_in: float = 0.17  # how far the tips turn toward the neck, dm

    def parts(self, scalp: Float) -> dict[str, Geometry]:
        """Make the opaque body of the hair and the locks over it."""
        bodies, locks = [], []
        rng = np.random.default_rng(1)
        for side in (1.0, -1.0):
            sheet = Sheet(self._side(side, 26, 26))
            across, along = np.meshgrid(np.arange(25) / 25, np.arange(25) / 25, indexing="ij")
            bodies.append(sheet.body((across >= 0.03) & (along < 0.97)))
            count = 36
            roots = np.concatenate([rng.uniform(0.02, 1, count), rng.uniform(0, 0.07, 12)])
            front = roots < 0.10
            count = len(roots)
            locks.append(
                Locks(
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
        return {"hair": join(bodies), "hair_tips": join(locks)}

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Return how far points of the skin are inside the hair; 0 is the hairline."""
        height = np.interp(
            x,
            [0.0, 0.15, 0.30, 0.42, 0.52, 0.60, 0.66, 0.72],
            [6.40, 6.40, 6.37, 6.32, 6.21, 6.04, 5.80, 5.55],
        )
        behind = (np.arctan2(x, z - 0.35) > 1.75) & (y > 5.1)
        return np.where(behind, 2.0, (y - height) / 0.13)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Return which points of the skin are never visible."""
        _, y, z = points.T
        return np.asarray((y > 6.60) | ((z < 0.0) & (y > 5.25)))

    def shaded(self, points: Float) -> Float:
        """Return how much the hair shades points of the skin: ears and sides of the neck."""
        return np.clip((0.66 - points[:, 2]) / 0.12, 0, 1)

    def _side(self, side: float, strands: int, steps: int) -> Float:
        """Comb one side down over the ear, (strands, rows, 3); ``side`` is 1 (left) or -1."""
        across = np.linspace(0.0, 1.0, strands)
        parting = side * self.parting * np.interp(across, [0, 0.6, 1], [1.0, 0.6, 0.0])
        # directions from the skull's center, by azimuth from the front and elevation, degrees:
        # along the parting over the crown, halfway down, and above the ears; the sides overlap at
        # the back
        azimuth = np.interp(across, [0.0, 0.25, 1.0], [60.0, 84.0, 183.0])
        halfway = np.interp(across, [0.0, 0.3, 1.0], [44.0, 80.0, 183.0]) + 0.4 * parting
        ways = [
            _way(parting, np.interp(across, [0, 0.35, 1], [34.0, 65.0, 112.0])),
            _way(halfway, np.interp(across, [0.0, 0.3, 1.0], [31.0, 62.0, 40.0])),
            _way(azimuth, np.full(strands, -6.0)),
        ]
        on_skull = np.linspace(0.0, 1.0, 2 * steps // 3 + 1)
        s = on_skull[None, :, None]  # quadratic curves through the three ways
        first, middle, last = (way[:, None] for way in ways)
        skull = (1 - s) ** 2 * first + 2 * s * (1 - s) * middle + s**2 * last
        skull /= np.linalg.norm(skull, axis=2, keepdims=True)
        # hair rises next to the parting
        swell = 1.0 + 0.035 * np.sin(np.pi * (0.15 + 0.85 * on_skull**0.7))[None, :, None]
        skull *= np.array([side * 0.745, 0.925, 0.90]) * swell
        skull[..., 2] *= np.where(skull[..., 2] > 0, 1.035, 1.0)  # over the forehead
        skull += SKULL

        # below the ears the hair hangs down, and its tips turn inward
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
        # bulge over the ear
        low = np.clip((6.35 - points[..., 1]) / 0.70, 0, 1)
        low = low * low * (3 - 2 * low)
        aside = np.exp(-(((azimuth[:, None] - 97) / 30) ** 2))
        points += (0.10 * low * aside)[..., None] * out[:, None]
        # below the cheekbone the front edge stays close to the face
        hug = np.exp(-((across / 0.10) ** 2))[:, None]
        hug = hug * np.clip((5.62 - points[..., 1]) / 0.25, 0, 1)
        points[..., 0] -= side * 0.05 * hug
        return points


def _way(azimuth: Float, elevation: Float) -> Float:
    """Return directions (A, 3) by azimuth from the front toward x, and elevation, degrees."""
    turn, up = np.radians(azimuth), np.radians(elevation)
    return np.stack([np.cos(up) * np.sin(turn), np.sin(up), np.cos(up) * np.cos(turn)], axis=1)


@dataclass(frozen=True, slots=True)
class Crop:
    """Short hair that grows from a whorl to the hairline, or is combed back from the forehead."""

    hairline: tuple[tuple[float, float, float], ...]  # left half, from the forehead to the nape
    heights: tuple[float, ...]  # on the head, dm
    thickness: tuple[float, ...]  # of the hair at these heights, dm
    ends: float = 0.0  # fraction of the thickness at the hairline; 0 is cropped, more a fringe
    combed_back: float = 0.0  # azimuth up to which hair is combed back, rad
    aside: float = 0.0  # how far hair is combed to the subject's left, rad
    locks: int = 270  # their number
    length: float = 0.42  # of the locks, dm
    width: float = 0.10
    lift: float = 0.03  # of the locks above the sheet, dm
    bun: float = 0.0  # radius of a bun behind the whorl, dm

    def _share(self, points: Float) -> tuple[Float, Float, Float]:
        """Return azimuth around the whorl (0 to pi), angle from it, and the hairline's angle."""
        azimuth, polar = _about_crown(points)
        line_azimuth, line_polar = _about_crown(np.array(self.hairline))
        order = np.argsort(line_azimuth)
        line = interpolate.PchipInterpolator(line_azimuth[order], line_polar[order])
        low, high = line_azimuth.min(), line_azimuth.max()
        return azimuth, polar, line(np.clip(azimuth, low, high))

    def _sheet(self, scalp: Float) -> tuple[Sheet, Float]:
        """Lay a sheet from the whorl to the hairline; return it and its lengths (A,), dm."""
        rows, columns = 61, 22
        turn = np.linspace(-np.pi, np.pi, rows)
        share = np.linspace(0.0, 1.0, columns)
        line = self._share(SKULL + _direction(turn, np.full(rows, 1.2)))[2]
        turns, polar = np.broadcast_arrays(turn[:, None], share[None, :] * line[:, None])
        direction = _direction(turns.ravel(), polar.ravel())
        base = SKULL + direction * _radius(scalp, direction)[:, None]
        t = np.tile(share, rows)
        height = np.interp(base[:, 1], self.heights, self.thickness)
        edge = np.clip((1.0 - t) / 0.22, 0, 1)
        height *= self.ends + (1 - self.ends) * np.sin(edge * np.pi / 2)
        points = base + direction * (0.010 + height)[:, None]
        points[:, 1] -= 0.10 * self.ends * np.clip(t - 0.7, 0, 1)
        return Sheet(points.reshape(rows, columns, 3)), 0.78 * line

    def parts(self, scalp: Float) -> dict[str, Geometry]:
        """Make the opaque body of the hair and the locks over it."""
        rng = np.random.default_rng(3)
        sheet, reach = self._sheet(scalp)
        along = np.tile(np.arange(21) / 21, (60, 1))
        body = sheet.body(along < 0.93)
        count = self.locks
        turn = rng.uniform(-np.pi, np.pi, count)
        line = np.interp(turn, np.linspace(-np.pi, np.pi, len(reach)), reach)
        length = self.length * rng.uniform(0.75, 1.25, count) / line
        # a constant number per area
        root = np.sqrt(rng.uniform(0.0, 1.0, count))
        start = np.clip(root - 0.45 * length, 0.0, 0.92)
        end = np.minimum(start + length, rng.uniform(0.93, 1.0, count))
        back = np.abs(turn) < self.combed_back * rng.uniform(0.85, 1.15, count)
        front = back & (root > 0.80)  # the hairline is dense
        root = np.where(front, rng.uniform(0.93, 1.0, count), root)
        start, end = (
            np.where(back, np.clip(root, 0.3, 1.0), start),
            np.where(back, np.clip(root - 1.2 * length, 0.04, 0.9), end),
        )
        combed = self.aside * np.clip(1.6 - np.abs(turn), 0, 1)
        low = np.clip(1.3 - (start + end) / 2, 0.3, 1)  # closer to the skin at temples and nape
        locks = Locks(
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
            body = join([body, _bun(self.bun, rng)])
        return {"hair": body, "hair_tips": tips}

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Return how far points of the skin are inside the hair; 0 is the hairline."""
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        _, polar, line = self._share(points)
        # below a fringe the skin is bare
        return ((line - polar - 0.5 * self.ends) * 0.75 / 0.10).reshape(x.shape)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Return which points of the skin are never visible."""
        _, polar, line = self._share(points)
        return np.asarray(polar < 0.70 * line) & (np.abs(points[:, 0]) < 0.60)

    def shaded(self, points: Float) -> Float:
        """Return how much the hair shades points of the skin: under it, and a little below."""
        _, polar, line = self._share(points)
        return 0.5 * np.clip((line - polar) / 0.2 + 0.6, 0, 1)


def _bun(radius: float, rng: np.random.Generator) -> Geometry:
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
    return Sheet(ball, SKULL + behind * (0.86 + 0.45 * radius)).body(
        np.ones((rows - 1, columns - 1), dtype=bool)
    )


def _direction(azimuth: Float, polar: Float) -> Float:
    """Return directions (N, 3) by azimuth from the front and angle from the whorl."""
    up = _CROWN / np.linalg.norm(_CROWN)
    side = np.array([1.0, 0.0, 0.0])
    front = np.cross(side, up)
    level = np.cos(azimuth)[:, None] * front + np.sin(azimuth)[:, None] * side
    return np.asarray(np.cos(polar)[:, None] * up + np.sin(polar)[:, None] * level)


def _about_crown(points: Float) -> tuple[Float, Float]:
    """Return azimuth from the front (0 to pi, on both sides) and angle from the whorl, (N,)."""
    up = _CROWN / np.linalg.norm(_CROWN)
    front = np.cross([1.0, 0.0, 0.0], up)
    away = points - SKULL
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    return np.arctan2(np.abs(away[:, 0]), away @ front), np.arccos(np.clip(away @ up, -1, 1))


def _radius(scalp: Float, direction: Float) -> Float:
    """Measure the skull's radius (N,) in given directions, without the ears."""
    x, y, z = scalp.T
    ear = (np.abs(x) > 0.60) & (y > 5.3) & (y < 6.0) & (z > -0.05) & (z < 0.62)
    skull = (y > 4.95) & ~ear & ((z < 1.0) | (y > 5.95))
    away = scalp[skull] - SKULL
    length = np.linalg.norm(away, axis=1)
    surface = interpolate.RBFInterpolator(
        away / length[:, None], length, neighbors=24, smoothing=1e-3, kernel="linear"
    )
    return np.asarray(surface(direction))


Hair = Bob | Crop
