"""Shared parts of all textures: smooth noise, mixing, encoding. Colors are sRGB, 0 to 1."""

from __future__ import annotations

import struct
import zlib
from fractions import Fraction

import av
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

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
