"""Sheets that hair lies on, their opaque bodies, and the locks over them.

A sheet leads from the roots (a parting, or a whorl) to the tips. Locks are laid over it like tapes.
Hair is made on the reference head (see ``assemble``) and warped onto each head with its skin. All
lengths are MakeHuman decimeters, y up, z toward the viewer, x to the subject's left.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kouxing.training.heads.parts import Geometry, grid_triangles

Float = NDArray[np.float64]

SKULL = np.array([0.0, 5.93, 0.42])
NUM_BANDS = 5  # of the texture, in a row: the body's, then those that locks choose from
_MARGIN = 0.04  # of a band, which no lock shows
_BODY_TONE = 0.75  # of the opaque body, a factor on the texture
_LOCK_ROWS = 9  # odd: coarse locks use every second row


class Sheet:
    """A surface along which hair lies: a grid (A, S, 3) of points, across and along the hair."""

    def __init__(self, points: Float, middle: Float | None = None) -> None:
        if middle is not None:
            points = points + middle
        self.points = points
        across, along = np.gradient(points, axis=0), np.gradient(points, axis=1)
        normals = np.cross(across, along)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9)
        if middle is None:  # of a head, or of hair that hangs around the neck
            middle = np.where(points[..., 1:2] > SKULL[1], SKULL, points * [0, 1, 0])
        away = points - middle
        self._turned = (normals * away).sum() < 0
        normals *= -1.0 if self._turned else 1.0
        self._layers = np.concatenate([points, normals], axis=2)

    def at(self, across: Float, along: Float) -> tuple[Float, Float]:
        """Interpolate points and outward directions (..., 3) at fractions 0 to 1 of the grid."""
        size = np.array(self.points.shape[:2])[:, None] - 1
        place = np.stack([across.ravel(), along.ravel()]) * size
        layers = np.stack(
            [
                ndimage.map_coordinates(self._layers[..., k], place, order=1, mode="nearest")
                for k in range(6)
            ],
            axis=1,
        ).reshape(*across.shape, 6)
        return layers[..., :3], layers[..., 3:]

    def body(self, shown: NDArray[np.bool_]) -> Geometry:
        """Make the opaque body from the quads (A - 1, S - 1) that are shown.

        The texture's first band repeats across it, alternately mirrored.
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
        return Geometry(
            vertices, compact.reshape(-1, 3), uv[used], np.full((len(used), 3), _BODY_TONE)
        )


@dataclass(slots=True)
class Locks:
    """Locks over a sheet; all fields except the last three have the shape (N,)."""

    across: Float  # position of the root across the sheet, fraction
    start: Float  # position of the root along the sheet, fraction
    end: Float  # position of the tip along the sheet, fraction
    width: Float  # dm
    lift: Float  # height of the middle above the sheet, dm
    drift: Float  # of the tip across the sheet, fraction
    tip_width: float  # fraction of the width
    root_lift: float  # fraction of the lift, as tip_lift
    tip_lift: float

    def part(self, sheet: Sheet, rng: np.random.Generator) -> Geometry:
        """Make three-sided tapes, from the inside outward, so that outer ones blend over inner."""
        order = np.argsort(self.lift)
        fields = (self.across, self.start, self.end, self.width, self.lift, self.drift)
        across, start, end, width, lift, drift = (
            np.asarray(values)[order, None] for values in fields
        )
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
        fall = 0.8 * rise[..., None] * out  # edges touch the sheet, or light would shine through
        points = np.stack([middle - half - fall, middle + ridge, middle + half - fall], axis=2)
        band = rng.integers(1, NUM_BANDS, len(order))[:, None, None]
        share = _MARGIN + (1 - 2 * _MARGIN) * np.array([0, 0.5, 1.0])
        mirrored = np.where(rng.random(len(order)) < 0.5, 1, -1)[:, None, None]
        u = (band + 0.5 + mirrored * (share - 0.5)[None, None, :]) / NUM_BANDS
        u, v = np.broadcast_arrays(u, np.broadcast_to(t[:, :, None], (1, _LOCK_ROWS, 3)))
        one = grid_triangles(_LOCK_ROWS, 3)[:, ::-1]
        first = _LOCK_ROWS * 3 * np.arange(len(order))[:, None, None]
        tone = rng.uniform(0.76, 1.0, (len(order), 1))
        # deeper locks are darker; roots have the body's tone
        tone *= np.interp(self.lift[order], [0, max(self.lift.max(), 1e-9)], [0.85, 1])[:, None]
        tone = _BODY_TONE + (tone - _BODY_TONE) * np.clip(t / 0.3, 0, 1)
        colors = np.repeat(tone.ravel(), 3)[:, None] * np.ones(3)
        return Geometry(
            points.reshape(-1, 3),
            (one[None] + first).reshape(-1, 3),
            np.stack([u, v], axis=-1).reshape(-1, 2),
            colors,
        )


def coarse_locks(count: int) -> NDArray[np.int64]:
    """Triangulate locks with ``count`` vertices, using every second row: (F, 3)."""
    rows = np.arange(0, _LOCK_ROWS, 2)
    used = (3 * rows[:, None] + np.arange(3)).ravel()
    one = used[grid_triangles(len(rows), 3)[:, ::-1]]
    first = np.arange(0, count, 3 * _LOCK_ROWS)[:, None, None]
    return (one[None] + first).reshape(-1, 3)


def join(parts: list[Geometry]) -> Geometry:
    """Join parts."""
    first = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Geometry(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + at for part, at in zip(parts, first, strict=False)]),
        np.concatenate([part.uv for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )
