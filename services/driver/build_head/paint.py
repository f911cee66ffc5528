"""Bake what skin, eyes, teeth, hair and lashes look like into small textures.

The two halves of the face share one texture: its columns count the angle round a vertical axis
inside the head (0 in front, pi behind), its rows the height. Colours are sRGB, 0 to 1.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, ndimage

from services.driver.build_head.parts import EYE_RINGS, IRIS_ANGLE, PUPIL_ANGLE

Float = NDArray[np.float64]

AXIS_Z = 0.35  # dm, of the vertical axis the angle is counted about
TOP_Y, BOTTOM_Y = 6.85, 4.15  # dm
SKIN_SIZE = (1280, 832)  # rows, columns
_ANGLES = np.radians([0.0, 70.0, 110.0, 180.0])
_COLUMNS = np.array([0.0, 0.80, 0.92, 1.0])


def skin_uv(vertices: Float) -> Float:
    """Texture coordinates (V, 2) of points (V, 3)."""
    angle = np.abs(np.arctan2(np.abs(vertices[:, 0]), vertices[:, 2] - AXIS_Z))
    u = np.interp(angle, _ANGLES, _COLUMNS)
    v = (TOP_Y - vertices[:, 1]) / (TOP_Y - BOTTOM_Y)
    uv: Float = np.clip(np.stack([u, v], axis=1), 0.0, 1.0)
    return uv


@dataclass(frozen=True, slots=True)
class FaceMap:
    """Where the texels of the skin lie on the neutral face."""

    x: Float  # (H, W) dm, distance from the middle plane
    y: Float
    z: Float
    angle: Float


def face_map(vertices: Float, uv: Float) -> FaceMap:
    """Carry positions from the outer skin's vertices to the texels."""
    rows, columns = SKIN_SIZE
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    values = np.abs(vertices)
    nearest = interpolate.NearestNDInterpolator(uv, values)
    linear = interpolate.LinearNDInterpolator(uv, values)(u, v)
    values = np.where(np.isfinite(linear), linear, nearest(u, v))
    # points that a fold hides under others leave specks
    values = ndimage.median_filter(values, (9, 9, 1))
    values = ndimage.gaussian_filter(values, (2, 2, 0))
    return FaceMap(
        x=values[..., 0],
        y=TOP_Y - v * (TOP_Y - BOTTOM_Y),
        z=values[..., 2],
        angle=np.interp(u, _COLUMNS, _ANGLES),
    )


def _noise(shape: tuple[int, int], sigma: float | tuple[float, float], seed: int) -> Float:
    """Smooth noise of unit variance."""
    white = np.random.default_rng(seed).standard_normal(shape)
    smooth: Float = ndimage.gaussian_filter(white, sigma, mode="wrap")
    smooth /= smooth.std()
    return smooth


def _spot(face: FaceMap, x: float, y: float, width: float, height: float) -> Float:
    """Soft spot (H, W) of height 1 at a place of the face."""
    spot: Float = np.exp(-(((face.x - x) / width) ** 2) - ((face.y - y) / height) ** 2)
    return spot


def _mix(image: Float, color: tuple[float, float, float], amount: Float) -> Float:
    return image + (np.array(color) - image) * np.clip(amount, 0, 1)[..., None]


SKIN = (0.890, 0.725, 0.625)
LIP = (0.720, 0.405, 0.385)
HAIR = (0.135, 0.105, 0.095)


def skin(face: FaceMap, brow: Float, lid: Float, lips: Float) -> Float:
    """Paint the skin.

    Parameters
    ----------
    face
        Where the texels lie.
    brow
        Middle line of a brow from the nose outwards (3, 2), x and y in dm.
    lid
        Edges of the eyelids from the nose outwards (N, 3): x, height of the upper and of the lower
        one in dm.
    lips
        From the middle outwards (N, 3): x, height of the upper and of the lower outline in dm.

    Returns
    -------
    sRGB (H, W, 3).
    """
    shape = face.x.shape
    image = np.broadcast_to(np.array(SKIN), (*shape, 3)).copy()
    blotch = _noise(shape, 26, 1)
    # the neck is thin: there the texture is squeezed, and grain would turn into streaks
    grain = np.clip((face.y - 4.70) / 0.25, 0.1, 1)
    image *= 1 + 0.010 * (grain * blotch)[..., None] * np.array([0.6, 1.0, 1.2])
    fine = 0.010 * _noise(shape, 1.1, 2) + 0.006 * _noise(shape, 3.5, 3)
    image *= 1 + (grain * fine)[..., None]
    rosy = (0.90, 0.56, 0.50)
    image = _mix(image, rosy, 0.34 * _spot(face, 0.42, 5.42, 0.20, 0.17))
    image = _mix(image, rosy, 0.16 * _spot(face, 0.0, 5.46, 0.10, 0.10))
    image = _mix(image, rosy, 0.10 * _spot(face, 0.0, 4.92, 0.16, 0.10))
    image = _mix(image, rosy, 0.28 * _spot(face, 0.74, 5.60, 0.10, 0.25) * (face.angle > 1.3))
    image = _mix(image, (0.80, 0.60, 0.53), 0.22 * _spot(face, 0.28, 5.70, 0.13, 0.035))
    image = _mix(image, (0.78, 0.57, 0.51), 0.18 * _spot(face, 0.27, 5.885, 0.14, 0.05))
    image = _mix(image, (0.95, 0.80, 0.70), 0.25 * _spot(face, 0.0, 6.15, 0.35, 0.20))
    image = _paint_lips(image, face, lips)
    image = _paint_eye_lines(image, face, lid[:, :2], lid[:, 2])
    image = _paint_brow(image, face, brow)
    return np.clip(_paint_hairline(image, face), 0, 1)


def _paint_lips(image: Float, face: FaceMap, lips: Float) -> Float:
    """Tint what lies between the two lip outlines."""
    upper, lower = (np.interp(face.x, lips[:, 0], lips[:, column]) for column in (1, 2))
    upper = upper - 0.012 * np.exp(-((face.x / 0.024) ** 2))  # Cupid's bow
    edge = 0.0065
    inside = 1 / (1 + np.exp((face.y - upper + 0.010) / edge))
    inside *= 1 / (1 + np.exp((lower + 0.012 - face.y) / edge))
    inside *= 1 / (1 + np.exp((face.x - lips[-1, 0] + 0.030) / 0.007))
    lines = _noise(face.x.shape, (14, 1.8), 4)
    color = np.array(LIP) * (1 + 0.022 * lines[..., None])
    image = image + (color - image) * (0.80 * inside)[..., None]
    below = _spot(face, 0.0, 5.005, 0.15, 0.024) * (1 - inside)
    return _mix(image, (0.70, 0.48, 0.42), 0.30 * below)


def _paint_eye_lines(image: Float, face: FaceMap, lid: Float, lower: Float) -> Float:
    """Darken the edges of the lids, where the lashes grow, and the upper lid's fold."""
    edge = np.interp(face.x, lid[:, 0], lid[:, 1])
    inside = 1 / (1 + np.exp(-(face.x - lid[0, 0] - 0.01) / 0.008))
    inside *= 1 / (1 + np.exp((face.x - lid[-1, 0] - 0.02) / 0.012))
    height = face.y - edge
    line = np.exp(-((height / 0.011) ** 2)) * inside
    fold = np.exp(-(((height - 0.052) / 0.010) ** 2)) * inside
    below = np.interp(face.x, lid[:, 0], lower)
    rim = np.exp(-(((face.y - below) / 0.010) ** 2)) * inside
    image = _mix(image, (0.52, 0.31, 0.28), 0.45 * rim)
    image = _mix(image, (0.16, 0.10, 0.09), 0.80 * line)
    return _mix(image, (0.60, 0.41, 0.36), 0.32 * fold)


def _paint_brow(image: Float, face: FaceMap, brow: Float) -> Float:
    """Strokes along a spindle that follows the brow's middle line."""
    curve = np.polynomial.Polynomial.fit(brow[:, 0], brow[:, 1], 2)
    along = (face.x - brow[0, 0]) / (brow[-1, 0] - brow[0, 0])
    across = face.y - curve(face.x)
    half = np.interp(along, [-0.05, 0.08, 0.45, 0.8, 1.05], [0.018, 0.034, 0.034, 0.022, 0.004])
    body = np.clip(1.35 - np.abs(across) / half, 0, 1)
    ends = np.clip((along + 0.08) / 0.16, 0, 1) * np.clip((1.06 - along) / 0.2, 0, 1)
    # hairs lean outwards: noise that is long along sheared lines
    shape = face.x.shape
    fine = np.random.default_rng(5).standard_normal(shape)
    lean = np.clip(along, 0, 1)
    hairs = np.zeros(shape)
    for slope, weight in ((1.6, 1 - lean), (0.35, lean)):
        strand = _directed(fine, slope, 9)
        hairs += weight * strand
    hairs = np.clip(0.66 + 0.24 * hairs / hairs.std(), 0, 1)
    amount = body * ends * hairs * (0.72 + 0.20 * np.clip(along, 0, 1))
    return _mix(image, (0.23, 0.165, 0.14), amount)


def _directed(white: Float, slope: float, length: int) -> Float:
    """Average noise along short lines, ``slope`` rows up for a column."""
    total = np.zeros_like(white)
    for step in np.linspace(-length, length, 2 * length + 1):
        scale = 1.0 / np.hypot(1.0, slope)
        total += ndimage.shift(white, (-slope * scale * step, scale * step), order=1, mode="wrap")
    smooth: Float = ndimage.gaussian_filter(total, 0.7)
    smooth /= smooth.std()
    return smooth


def hairline_height(x: Float) -> Float:
    """Height of the hairline above a point of the face, dm."""
    return np.interp(
        x,
        [0.0, 0.15, 0.30, 0.42, 0.52, 0.60, 0.66, 0.72],
        [6.43, 6.44, 6.42, 6.36, 6.24, 6.05, 5.80, 5.55],
    )


def _paint_hairline(image: Float, face: FaceMap) -> Float:
    shape = face.x.shape
    strands = _noise(shape, (14, 1.3), 6)
    above = face.y - hairline_height(face.x) + 0.005 * strands + 0.010 * _noise(shape, (30, 12), 7)
    behind = (face.angle > 1.75) & (face.y > 5.1)
    amount = np.where(behind, 1.0, np.clip(above / 0.13 + 0.3, 0, 1) ** 1.6)
    return _mix(image, HAIR, amount)


def eye(size: int = 256) -> Float:
    """Paint an eyeball; the distance from the middle counts the angle from the pupil."""
    place = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(place, place)
    angle = np.hypot(x, y) * EYE_RINGS[-1]
    turn = np.arctan2(y, x)
    rng = np.random.default_rng(8)
    spokes = np.zeros((size, size))
    for frequency in (23, 41, 67, 97):
        spokes += np.sin(frequency * turn + rng.uniform(0, 6.28) + 2 * rng.standard_normal())
    white = np.array([0.90, 0.885, 0.87]) - 0.10 * np.clip(angle / 1.2, 0, 1)[..., None] * np.array(
        [0.2, 1.0, 1.0]
    )
    image = white
    within = np.clip((angle - PUPIL_ANGLE) / (IRIS_ANGLE - PUPIL_ANGLE), 0, 1)
    iris = np.array([0.17, 0.105, 0.07]) * (1 + 0.08 * spokes[..., None])
    iris = iris + np.array([0.10, 0.06, 0.035]) * (1 - np.abs(2 * within - 0.9))[..., None]
    iris = iris + np.array([0.10, 0.06, 0.03]) * np.clip(y / 0.3, -0.4, 1)[..., None]
    iris *= np.clip(1.25 - within**4, 0.3, 1)[..., None]
    soft = 0.016
    image = _mix_images(image, iris, 1 / (1 + np.exp((angle - IRIS_ANGLE) / soft)))
    pupil = np.array([0.02, 0.016, 0.016])
    image = _mix_images(image, pupil, 1 / (1 + np.exp((angle - PUPIL_ANGLE) / 0.010)))
    return np.clip(image, 0, 1)


def _mix_images(low: Float, high: Float, amount: Float) -> Float:
    return low + (high - low) * amount[..., None]


def teeth(widths: tuple[float, ...], size: tuple[int, int] = (128, 768)) -> Float:
    """Paint a row of teeth: gum at the top of the texture, cutting edge at 0.7, back below."""
    rows, columns = size
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    bounds = np.concatenate([[0.0], np.cumsum(widths)])
    place = np.abs(u - 0.5) * 2 * bounds[-1]
    tooth = np.clip(np.searchsorted(bounds, place) - 1, 0, len(widths) - 1)
    within = (place - bounds[tooth]) / np.array(widths)[tooth]
    gap = np.minimum(within, 1 - within) * np.array(widths)[tooth]  # mm to the next tooth
    ivory = np.array([0.965, 0.94, 0.885])
    image = np.broadcast_to(ivory, (rows, columns, 3)).copy()
    image *= 1 - 0.10 * (np.clip(0.45 - v, 0, 1) / 0.45)[..., None] * np.array([0.3, 0.6, 1.0])
    image *= 1 + 0.03 * np.clip((v - 0.5) / 0.2, 0, 1)[..., None]
    image *= (1 - 0.42 * np.exp(-((gap / 0.28) ** 2)) * (v < 0.74))[..., None]
    arch = 0.30 - 0.16 * np.sin(np.pi * within)
    gum = 1 / (1 + np.exp((v - arch) / 0.012))
    image = _mix(image, (0.72, 0.36, 0.36), gum)
    return np.clip(image, 0, 1)


def tongue(size: int = 64) -> Float:
    """Paint the tongue."""
    bumps = _noise((size, size), 1.0, 9)[..., None]
    return np.clip(np.array([0.72, 0.36, 0.36]) * (1 + 0.05 * bumps), 0, 1)


def cloth(size: int = 16) -> Float:
    """Paint a plain knitted fabric."""
    return np.broadcast_to(np.array([0.20, 0.29, 0.38]), (size, size, 3)).copy()


def hair(size: tuple[int, int] = (512, 512)) -> Float:
    """Paint strands that run down the texture; the tips and the front edge are thin (RGBA)."""
    rows, columns = size
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    strands = 0.7 * _noise(size, (70, 1.2), 11) + 0.5 * _noise(size, (90, 4), 12)
    shine = np.exp(-(((v - 0.20 + 0.012 * strands) / 0.07) ** 2))
    value = 1 + 0.22 * strands + 0.55 * shine
    image = np.array(HAIR) * value[..., None] + np.array([0.045, 0.03, 0.02]) * shine[..., None]
    tips = (
        (0.99 - v) / 0.045 + 0.35 * _noise(size, (40, 1.2), 13) + 0.35 * _noise(size, (40, 5), 14)
    )
    front = np.clip(u / 0.055, 0, 1)
    alpha = np.clip(tips, 0, 1) * front * front * (3 - 2 * front)
    painted: Float = np.clip(np.concatenate([image, alpha[..., None]], axis=2), 0, 1)
    return painted


def lashes(size: tuple[int, int] = (64, 256)) -> Float:
    """Paint lashes that grow from the bottom row of the texture and thin out (RGBA)."""
    rows, columns = size
    rng = np.random.default_rng(15)
    alpha = np.zeros(size)
    height = np.arange(rows)[::-1] / rows
    for root in np.linspace(6, columns - 6, 46) + rng.uniform(-2, 2, 46):
        length = rng.uniform(0.55, 0.95)
        bend = rng.uniform(-9, 9) + (root / columns - 0.5) * 26
        middle = root + bend * height**2
        width = 1.7 * np.clip(1 - height / length, 0, 1) ** 0.6
        near = np.clip(width[:, None] - np.abs(np.arange(columns) - middle[:, None]) + 0.4, 0, 1)
        alpha = np.maximum(alpha, near * (height < length)[:, None])
    color = np.broadcast_to(np.array([0.07, 0.05, 0.05]), (*size, 3))
    return np.concatenate([color, 0.85 * alpha[..., None]], axis=2)


def encode(image: Float, quality: int = 3) -> bytes:
    """Encode (H, W, 3) as JPEG (``quality`` 2 is best, 31 worst), (H, W, 4) as PNG."""
    pixels = np.ascontiguousarray(np.round(image * 255).astype(np.uint8))
    if pixels.shape[2] == 4:
        return _png(pixels)
    codec = av.CodecContext.create("mjpeg", "w")
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt = "yuvj444p"
    codec.time_base = Fraction(1, 25)
    codec.options = {"qmin": str(quality), "qmax": str(quality)}
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuvj444p")
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Write the bare chunks: FFmpeg's own add some that a glTF must not have."""
    rows, columns, channels = pixels.shape
    # filter 2 (difference from the row above) suits strands that run down
    above = np.concatenate([np.zeros_like(pixels[:1]), pixels[:-1]])
    lines = np.concatenate(
        [np.full((rows, 1), 2, np.uint8), (pixels - above).reshape(rows, columns * channels)],
        axis=1,
    )

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(lines.tobytes(), 9))
        + chunk(b"IEND", b"")
    )
