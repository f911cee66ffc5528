"""Textures: noise, mixing, encoding, and all that are not skin. Colors are sRGB, 0 to 1."""

import struct
import zlib
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from kouxing.training.heads.hair import NUM_BANDS
from kouxing.training.heads.parts import EYE_RINGS, IRIS_ANGLE, PUPIL_ANGLE

Float = NDArray[np.float64]
Color = tuple[float, float, float]


def noise(shape: tuple[int, int], sigma: float | tuple[float, float], seed: int) -> Float:
    """Make smooth noise of unit variance."""
    white = np.random.default_rng(seed).standard_normal(shape)
    smooth: Float = ndimage.gaussian_filter(white, sigma, mode="wrap")
    smooth /= smooth.std()
    return smooth


def mix(image: Float, color: Color, amount: Float) -> Float:
    """Blend a color into an image (H, W, 3) by an amount (H, W)."""
    return image + (np.array(color) - image) * np.clip(amount, 0, 1)[..., None]


def encode(image: Float) -> bytes:
    """Encode (H, W, 3) as JPEG, (H, W, 4) as PNG."""
    pixels = np.ascontiguousarray(np.round(image * 255).astype(np.uint8))
    if pixels.shape[2] == 4:
        return _png(pixels)
    codec = av.CodecContext.create("mjpeg", "w")
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt = "yuvj444p"
    codec.time_base = Fraction(1, 25)
    codec.options = {"qmin": "3", "qmax": "3"}  # 2 is best, 31 worst
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="yuvj444p")
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """Encode as PNG without the further chunks of FFmpeg, which glTF does not allow."""
    rows, columns, channels = pixels.shape
    # filter 2 (difference from the row above) suits vertical strands
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


def eye(color: Color, iris_size: float = 1.0, size: int = 256) -> Float:
    """Paint an eyeball; the distance from the center is the angle from the pupil.

    ``color`` is the lightest color of the iris, ``iris_size`` scales iris and pupil.
    """
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
    angle = angle / iris_size
    within = np.clip((angle - PUPIL_ANGLE) / (IRIS_ANGLE - PUPIL_ANGLE), 0, 1)
    bright = 0.55 + 0.30 * (1 - np.abs(2 * within - 0.9)) + 0.45 * np.clip(y / 0.3, -0.5, 1)
    iris = np.array(color) * (bright * (1 + 0.10 * spokes))[..., None]
    iris *= np.clip(1.25 - within**4, 0.25, 1)[..., None]  # a dark ring around it
    soft = 0.016
    image = _mix_images(image, iris, 1 / (1 + np.exp((angle - IRIS_ANGLE) / soft)))
    pupil = np.array([0.02, 0.016, 0.016])
    image = _mix_images(image, pupil, 1 / (1 + np.exp((angle - PUPIL_ANGLE) / 0.010)))
    return np.clip(image, 0, 1)


def _mix_images(low: Float, high: Float, amount: Float) -> Float:
    return low + (high - low) * amount[..., None]


def teeth(widths: tuple[float, ...], size: tuple[int, int] = (128, 768)) -> Float:
    """Paint a row of teeth: gum at the top, cutting edge at 0.7, back at the bottom."""
    rows, columns = size
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    bounds = np.concatenate([[0.0], np.cumsum(widths)])
    place = np.abs(u - 0.5) * 2 * bounds[-1]
    tooth = np.clip(np.searchsorted(bounds, place) - 1, 0, len(widths) - 1)
    within = (place - bounds[tooth]) / np.array(widths)[tooth]
    gap = np.minimum(within, 1 - within) * np.array(widths)[tooth]  # mm to the next tooth
    ivory = np.array([0.985, 0.965, 0.925])
    image = np.broadcast_to(ivory, (rows, columns, 3)).copy()
    image *= 1 - 0.10 * (np.clip(0.45 - v, 0, 1) / 0.45)[..., None] * np.array([0.3, 0.6, 1.0])
    image *= 1 + 0.03 * np.clip((v - 0.5) / 0.2, 0, 1)[..., None]
    image *= (1 - 0.42 * np.exp(-((gap / 0.28) ** 2)) * (v < 0.74))[..., None]
    arch = 0.30 - 0.16 * np.sin(np.pi * within)
    gum = 1 / (1 + np.exp((v - arch) / 0.012))
    image = mix(image, (0.72, 0.36, 0.36), gum)
    return np.clip(image, 0, 1)


def tongue(size: int = 128) -> Float:
    """Paint the tongue from above, with its tip at the bottom: papillae and a groove."""
    rough = 0.06 * noise((size, size), 0.8, 9) + 0.02 * noise((size, size), 4.0, 10)
    across = (np.arange(size) + 0.5) / size - 0.5
    groove = 0.22 * np.exp(-((across / 0.035) ** 2))
    image = np.array([0.80, 0.45, 0.44]) * (1 + rough - groove)[..., None]
    paler = np.clip(1.5 * rough, 0, 1)  # the tops of the papillae
    return np.clip(mix(image, (0.93, 0.68, 0.66), paler), 0, 1)


def cloth(color: Color, size: int = 16) -> Float:
    """Paint a plain knitted fabric."""
    return np.broadcast_to(np.array(color), (size, size, 3)).copy()


def hair(color: Color, size: tuple[int, int] = (256, 96)) -> Float:
    """Paint vertical strands in bands, one opaque and the others thinning out (RGBA).

    ``size`` is a band's. Roots fade in at the top, tips thin out at the bottom.
    """
    rows, columns = size
    v = ((np.arange(rows) + 0.5) / rows)[:, None]
    edge = 1 - np.abs((np.arange(columns) + 0.5) / columns * 2 - 1)[None, :]  # 0 at the band's edge
    contrast = 0.22 - 0.14 * max(color)  # shadows are more visible in light hair
    bands = []
    for band in range(NUM_BANDS):
        strands = 0.8 * noise(size, (60, 0.9), 16 + band) + 0.5 * noise(size, (80, 3.5), 30 + band)
        image = np.array(color) * (1 + contrast * np.clip(strands, -2, 2.5))[..., None]
        alpha = np.ones(size)
        if band:
            ragged = 0.8 * noise(size, (50, 1.0), 50 + band) + 0.4 * noise(size, (60, 4), 70 + band)
            alpha = np.clip((0.985 - v) / 0.11 + 0.45 * ragged, 0, 1)
            alpha *= np.clip((1.0 - v) / 0.04, 0, 1) * np.clip(v / 0.10 + 0.25 * ragged, 0, 1)
            alpha *= np.clip((edge - 0.08) / 0.30 + 0.35 * ragged, 0, 1) * (edge > 0.06)
        bands.append(np.concatenate([image, alpha[..., None]], axis=2))
    painted: Float = np.clip(np.concatenate(bands, axis=1), 0, 1)
    # few levels compress well
    painted[..., :3] = np.round(painted[..., :3] * 100) / 100
    painted[..., 3] = np.round(painted[..., 3] * 20) / 20
    return painted


def lashes(size: tuple[int, int] = (64, 256)) -> Float:
    """Paint lashes that grow from the bottom row and thin out (RGBA)."""
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
