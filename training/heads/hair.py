"""Hair: a bob combed from a parting, and short cuts made of thin shells over the skull.

Hair is made on the reference head (see ``assemble``) and warped onto each head with its skin. All
lengths are MakeHuman decimetres, y up, z towards the viewer, x to the subject's left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from training.heads.parts import Part, grid_triangles

Float = NDArray[np.float64]

_SKULL = np.array([0.0, 5.93, 0.42])
_CROWN = np.array([0.0, 0.97, -0.24])  # direction from the skull's middle in which hair whorls
NUM_SHELLS = 4  # of a short cut; they lie side by side in its texture


class Hair(Protocol):
    """A way to wear one's hair."""

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque body of the hair and what thins out, over points (N, 3) of the skin."""
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


# ---- bob --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Bob:
    """Hair to the jaw, parted in the middle."""

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque body of the hair, and its thin front edge and tips."""
        made = {}
        for name, rise, tips in (("hair", 0.0, False), ("hair_tips", 0.005, True)):
            sheets = [_bob_side(side, rise, 38, 34) for side in (1.0, -1.0)]
            count = len(sheets[0].vertices)
            triangles = np.concatenate([sheets[0].triangles, sheets[1].triangles + count])
            uv = np.concatenate([sheet.uv for sheet in sheets])
            u, v = uv[triangles, 0], uv[triangles, 1]
            shown = (
                (u.min(axis=1) < 0.16) | (v.max(axis=1) > 0.80)
                if tips
                else (u.min(axis=1) > 0.06) & (v.max(axis=1) < 0.90)
            )
            vertices = np.concatenate([sheet.vertices for sheet in sheets])
            made[name] = _used(vertices, triangles[shown], uv)
        return made

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Say how far into the hair points of the skin lie."""
        height = np.interp(
            x,
            [0.0, 0.15, 0.30, 0.42, 0.52, 0.60, 0.66, 0.72],
            [6.43, 6.44, 6.42, 6.36, 6.24, 6.05, 5.80, 5.55],
        )
        behind = (np.arctan2(x, z - 0.35) > 1.75) & (y > 5.1)
        return np.where(behind, 2.0, (y - height) / 0.13)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Say which points of the skin can never be seen."""
        _, y, z = points.T
        return np.asarray((y > 6.56) | ((z < 0.0) & (y > 5.25)))

    def shaded(self, points: Float) -> Float:
        """Share of the hair's shadow: ears and sides of the neck."""
        return np.clip((0.66 - points[:, 2]) / 0.12, 0, 1)


def _used(vertices: Float, triangles: NDArray[np.int64], uv: Float) -> Part:
    """Keep the vertices that triangles use."""
    used, compact = np.unique(triangles, return_inverse=True)
    return Part(vertices[used], compact.reshape(-1, 3), uv[used], np.ones((len(used), 3)))


def _bezier(points: Float, t: Float) -> Float:
    """Evaluate quadratic curves with control points (3, A, 2) at (T,) as (A, T, 2)."""
    first, middle, last = points[:, :, None, :]
    s = t[None, :, None]
    curve: Float = (1 - s) ** 2 * first + 2 * s * (1 - s) * middle + s**2 * last
    return curve


def _bob_side(side: float, rise: float, strands: int, steps: int) -> Part:
    """Comb one side of a bob from the parting over the ear down to the jaw.

    Parameters
    ----------
    side
        1 for the subject's left, -1 for the right.
    rise
        How far the front edge and the tips stand off, dm.
    strands, steps
        Size of the grid across and along the hair.
    """
    noise = np.random.default_rng(1)
    across = np.linspace(0.0, 1.0, strands)
    # in degrees about the skull's centre: azimuth from the front, elevation
    azimuth_end = np.interp(across, [0.0, 0.25, 1.0], [58.0, 82.0, 180.0])
    start = np.stack(
        [np.zeros(strands), np.interp(across, [0, 0.35, 1], [38.0, 66.0, 112.0])], axis=1
    )
    middle = np.stack(
        [
            np.interp(across, [0.0, 0.3, 1.0], [47.0, 80.0, 175.0]),
            np.interp(across, [0.0, 0.3, 1.0], [37.0, 62.0, 75.0]),
        ],
        axis=1,
    )
    end = np.stack([azimuth_end, np.full(strands, -6.0)], axis=1)
    on_skull = np.linspace(0.0, 1.0, steps // 2 + 1)
    angles = np.radians(_bezier(np.stack([start, middle, end]), on_skull))
    azimuth, elevation = angles[..., 0], angles[..., 1]
    radii = np.array([0.745, 0.925, 0.90])
    swell = 1.0 + 0.05 * np.sin(np.pi * on_skull)[None, :]
    skull = np.stack(
        [
            side * np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
            np.cos(elevation) * np.cos(azimuth),
        ],
        axis=2,
    ) * (radii * swell[..., None])
    skull += _SKULL

    # below the ears the hair hangs and turns inwards at the tips
    drop = np.linspace(0.0, 1.0, steps - steps // 2)[1:]
    length = np.interp(across, [0.0, 0.15, 0.5, 1.0], [1.02, 1.08, 1.10, 1.06])
    length = length + 0.025 * noise.standard_normal(strands)
    last, before = skull[:, -1], skull[:, -2]
    lean = (last - before) / np.maximum(np.linalg.norm(last - before, axis=1, keepdims=True), 1e-9)
    facing = azimuth[:, -1]
    out = np.stack([side * np.sin(facing), np.zeros(strands), np.cos(facing)], axis=1)
    sway = 0.05 * np.sin(np.pi * np.minimum(drop * 0.9, 1))[None, :] - 0.17 * drop[None, :] ** 3
    hang = (
        last[:, None]
        - length[:, None, None] * drop[None, :, None] * np.array([0.0, 1.0, 0.0])
        + out[:, None] * (sway * (1 + 0.05 * noise.standard_normal((strands, 1))))[..., None]
    )
    hang += 0.04 * (lean * [1, 0, 1])[:, None] * drop[None, :, None]
    points = np.concatenate([skull, hang], axis=1)  # (strands, rows, 3)
    # lie over the ear
    low = np.clip((6.35 - points[..., 1]) / 0.70, 0, 1)
    low = low * low * (3 - 2 * low)
    aside = np.exp(-(((azimuth[:, -1:] - np.radians(97)) / np.radians(30)) ** 2))
    points += (0.10 * low * aside)[..., None] * out[:, None]
    # below the cheekbone the front edge keeps to the face
    hug = np.exp(-((across / 0.10) ** 2))[:, None] * np.clip((5.62 - points[..., 1]) / 0.25, 0, 1)
    points[..., 0] -= side * 0.05 * hug
    rows = points.shape[1]
    walked = np.linspace(0.0, 1.0, rows)
    lift = np.maximum(
        np.clip((walked[None, :] - 0.80) / 0.08, 0, 1),
        np.clip((0.16 - across[:, None]) / 0.06, 0, 1),
    )
    outward = points - np.where(points[..., 1:2] > _SKULL[1], _SKULL, points * [0, 1, 0])
    outward /= np.linalg.norm(outward, axis=2, keepdims=True)
    points += rise * lift[..., None] * outward
    uv = np.stack(
        [
            np.broadcast_to(across[:, None], (strands, rows)),
            np.broadcast_to(walked[None, :], (strands, rows)),
        ],
        axis=2,
    )
    # the thin front edge comes last, over the hair behind it
    triangles = grid_triangles(strands, rows)[::-1]
    if side < 0:
        triangles = triangles[:, ::-1]
    return Part(points.reshape(-1, 3), triangles, uv.reshape(-1, 2), np.ones((strands * rows, 3)))


# ---- short cuts -------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Crop:
    """Short hair that grows from a whorl to the hairline.

    Attributes
    ----------
    hairline
        Points (N, 3) of the left half from the middle of the forehead over the ear to the nape.
    heights, thickness
        Thickness of the hair by height on the head, both in dm.
    ends
        Share of the thickness that is left at the hairline: 0 for cropped hair, more for a fringe.
    """

    hairline: tuple[tuple[float, float, float], ...]
    heights: tuple[float, ...]
    thickness: tuple[float, ...]
    ends: float = 0.0

    def _share(self, points: Float) -> tuple[Float, Float, Float]:
        """Azimuth about the whorl (0 in front to pi), angle from it, and that of the hairline."""
        azimuth, polar = _about_crown(points)
        line_azimuth, line_polar = _about_crown(np.array(self.hairline))
        order = np.argsort(line_azimuth)
        line = interpolate.PchipInterpolator(line_azimuth[order], line_polar[order])
        low, high = line_azimuth.min(), line_azimuth.max()
        return azimuth, polar, line(np.clip(azimuth, low, high))

    def parts(self, scalp: Float) -> dict[str, Part]:
        """Make the opaque inner shell, and the strands of the outer ones."""
        rows, columns = 20, 81
        turn = np.linspace(-np.pi, np.pi, columns)
        share = np.linspace(0.0, 1.0, rows) ** 0.8  # closer to each other at the hairline
        line = self._share(_SKULL + _direction(turn, np.full(columns, 1.2)))[2]
        turn, polar = np.broadcast_arrays(turn, share[:, None] * line)
        direction = _direction(turn.ravel(), polar.ravel())
        base = _SKULL + direction * _radius(scalp, direction)[:, None]
        t = np.repeat(share, columns)
        height = np.interp(base[:, 1], self.heights, self.thickness)
        height += 0.08 * np.sin(np.pi * np.clip(t / 0.65, 0, 1))  # rounds the top
        edge = np.clip((1.0 - t) / 0.16, 0, 1)
        height *= self.ends + (1 - self.ends) * np.sin(edge * np.pi / 2)
        rng = np.random.default_rng(3)
        knots = np.linspace(-np.pi, np.pi, 41)
        clumps: Float = interpolate.CubicSpline(knots, rng.standard_normal(41))(turn.ravel())
        height *= 1 + 0.06 * clumps * np.clip(t / 0.3, 0, 1)
        triangles = grid_triangles(rows, columns)[:, ::-1]
        shells = []
        for shell, level in enumerate((0.70, 0.82, 0.92, 1.0)):
            # outer hair reaches a little farther than its roots, as it hangs over them
            points = base + direction * (0.012 + level * height)[:, None]
            points[:, 1] -= 0.10 * self.ends * level * np.clip(t - 0.7, 0, 1)
            u = (np.abs(turn.ravel()) / np.pi * 0.96 + 0.02 + shell) / NUM_SHELLS
            shells.append((points, np.stack([u, t], axis=1)))
        body = triangles[(t[triangles].max(axis=1) < 0.80)]
        points, uv = shells[0]
        made = {"hair": _used(points, body, uv)}
        count = len(base)
        made["hair_tips"] = _used(
            np.concatenate([points for points, _ in shells]),
            np.concatenate(
                [triangles[t[triangles].max(axis=1) > 0.72]]
                + [triangles + shell * count for shell in range(1, NUM_SHELLS)]
            ),
            np.concatenate([uv for _, uv in shells]),
        )
        return made

    def roots(self, x: Float, y: Float, z: Float) -> Float:
        """Say how far into the hair points of the skin lie."""
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        _, polar, line = self._share(points)
        # a fringe hangs over bare skin
        return ((line - polar - 0.5 * self.ends) * 0.75 / 0.10).reshape(x.shape)

    def hidden(self, points: Float) -> NDArray[np.bool_]:
        """Say which points of the skin can never be seen."""
        _, polar, line = self._share(points)
        return np.asarray(polar < 0.75 * line) & (np.abs(points[:, 0]) < 0.60)

    def shaded(self, points: Float) -> Float:
        """Share of the hair's shadow: what lies under it, and a little below."""
        _, polar, line = self._share(points)
        return 0.5 * np.clip((line - polar) / 0.2 + 0.6, 0, 1)


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
