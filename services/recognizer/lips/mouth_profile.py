"""A mouth profile: corrects the lip predictor for one speaker.

    y' = s y + b + r [h, u]

y are the predicted FAPs (``lip_predictor.py``); h and u are hidden values of the predictor. A
profile fits only the predictor that it was learned with.

======== ====================================================== =================== ===========
symbol   meaning                                                shape               unit
======== ====================================================== =================== ===========
s        scale of each FAP                                      (15,)               1
b        offset of each FAP                                     (15,)               FAP units
r        residual: the speaker's deviation from the model       (2 units, delays,   FAP units
                                                                15)
======== ====================================================== =================== ===========

Format in files and messages:

    16 bytes  "kouxing voice 1" and a line feed
    32 bytes  SHA-256 of the model
    rest      s, b and r: float16, little endian
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.files.user_file import open_file

_MAGIC = b"kouxing voice 1\n"  # the historical name, kept for existing files
_DIGEST_BYTES = 32
MAX_SCALE, MAX_OFFSET, MAX_RESIDUAL = 4.0, 2000.0, 2000.0


@dataclass(frozen=True, kw_only=True)
class MouthProfile:
    """Corrections of the predicted FAPs for one speaker."""

    scale: Floats  # (15,)
    offset: Floats  # (15,)
    residual: Floats  # (2 units, delays, 15)

    def to_bytes(self, model_digest: bytes) -> bytes:
        """Serialize the profile; values out of bounds are clipped."""
        bounded = (
            np.clip(self.scale, 0, MAX_SCALE),
            np.clip(self.offset, -MAX_OFFSET, MAX_OFFSET),
            np.clip(self.residual, -MAX_RESIDUAL, MAX_RESIDUAL),
        )
        arrays = [values.astype("<f2").tobytes() for values in bounded]
        return b"".join((_MAGIC, model_digest, *arrays))


def parse_mouth_profile(
    content: bytes, model_digest: bytes, shape: tuple[int, int, int]
) -> MouthProfile:
    """Parse a profile from an untrusted source, for the lip predictor with this SHA-256.

    ``shape`` is the shape of the predictor's residual.

    Raises ``UserError`` if it is not a profile, fits another model, or its values are out of
    bounds.
    """
    values_at = len(_MAGIC) + _DIGEST_BYTES
    if content[: len(_MAGIC)] != _MAGIC:
        raise UserError("it is not a mouth profile; make one with 'kouxing adapt'")
    if content[len(_MAGIC) : values_at] != model_digest:
        raise UserError("it was made for another lip model; run 'kouxing adapt' again")
    num_faps = shape[2]
    sizes = (num_faps, num_faps, int(np.prod(shape)))
    if len(content) != values_at + 2 * sum(sizes):
        raise UserError(
            f"it has {len(content)} bytes instead of {values_at + 2 * sum(sizes)}; copy it again"
        )
    values = np.frombuffer(content[values_at:], "<f2").astype(np.float32)
    scale, offset, residual = np.split(values, np.cumsum(sizes)[:-1])
    in_bounds = (  # false for NaN
        (scale >= 0).all()
        and (scale <= MAX_SCALE).all()
        and (np.abs(offset) <= MAX_OFFSET).all()
        and (np.abs(residual) <= MAX_RESIDUAL).all()
    )
    if not in_bounds:
        raise UserError("its values are out of bounds; run 'kouxing adapt' again")
    return MouthProfile(scale=scale, offset=offset, residual=residual.reshape(shape))


def read_mouth_profile(path: Path) -> bytes:
    """Read a file that starts like a mouth profile; raises ``UserError`` if it does not."""
    with open_file(path, sys.maxsize) as file:
        content = file.read(MAX_MOUTH_PROFILE_BYTES + 1)
    if content[: len(_MAGIC)] != _MAGIC or len(content) > MAX_MOUTH_PROFILE_BYTES:
        raise UserError(f"{path} is not a mouth profile; make one with 'kouxing adapt'")
    return content
