"""Decodes and encodes single pictures. The files may be untrusted."""

from fractions import Fraction
from typing import Any

import av
import numpy as np

from kouxing.shared.arrays import UInt8
from kouxing.shared.errors import UserError

MAX_PIXELS = 8192 * 8192
# first bytes: decoder. FFmpeg must not guess the format: it would open playlists of other files
_CODECS = {b"\x89PNG": "png", b"\xff\xd8\xff": "mjpeg", b"RIFF": "webp"}


def decode(encoded: bytes, name: str) -> UInt8:
    """Decode a PNG, JPEG or WebP into (H, W, 4); error texts contain the name.

    Raises ``UserError`` if the format is different, or the picture is damaged or has more than
    ``MAX_PIXELS``.
    """
    codec = next((codec for magic, codec in _CODECS.items() if encoded.startswith(magic)), None)
    if codec is None:
        raise UserError(f"texture {name!r} is not PNG, JPEG or WebP; convert it")
    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.options = {"max_pixels": str(MAX_PIXELS)}
    decoder.thread_count = 1
    try:
        frames = [*decoder.decode(av.Packet(encoded)), *decoder.decode(None)]
        pixels = np.asarray(frames[0].to_ndarray(format="rgba"), dtype=np.uint8)
    except (av.FFmpegError, IndexError, ValueError, MemoryError) as error:
        raise UserError(
            f"texture {name!r} is damaged or has more than {MAX_PIXELS / 1e6:.0f} million pixels;"
            " export a smaller one"
        ) from error
    return pixels


def encode(image: UInt8) -> bytes:
    """Encode a picture (H, W, 3), or (H, W, 4) with alpha, as PNG."""
    kind = "rgba" if image.shape[2] == 4 else "rgb24"
    encoder = av.CodecContext.create("png", "w")
    encoder.height, encoder.width = image.shape[:2]
    encoder.pix_fmt, encoder.time_base = kind, Fraction(1)
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=kind)
    return b"".join(bytes(packet) for packet in [*encoder.encode(frame), *encoder.encode(None)])
