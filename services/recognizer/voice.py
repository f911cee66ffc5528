"""A voice: how one speaker's lips differ from those that lips from sound make of anybody's speech.

    y' = s y + b + r [h, u]

y are the FAPs that a model makes (``lips.py``), h and u its inner values. A voice belongs to the
model that it was learnt with.

======== ====================================================== =================== ===========
symbol   meaning                                                shape               unit
======== ====================================================== =================== ===========
s        scale of each FAP                                      (15,)               1
b        offset of each FAP                                     (15,)               FAP units
r        residual: what the model does not know of the speaker  (2 units, delays,   FAP units
                                                                15)
======== ====================================================== =================== ===========

A profile is a voice in bytes, as it lies in files and goes over the wire:

    16 bytes  "kouxing voice 1" and a line feed
    32 bytes  SHA-256 of the model
    rest      s, b and r: float16, little endian
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_models import MAX_VOICE_BYTES

Floats = NDArray[np.float32]

_HEAD = b"kouxing voice 1\n"
_DIGEST_BYTES = 32
MAX_SCALE, MAX_OFFSET, MAX_RESIDUAL = 4.0, 2000.0, 2000.0


@dataclass(frozen=True, kw_only=True)
class Voice:
    """One speaker's voice."""

    scale: Floats  # (15,)
    offset: Floats  # (15,)
    residual: Floats  # (2 units, delays, 15)

    def to_profile(self, model_digest: bytes) -> bytes:
        """Return the voice's profile; values out of the bounds are clipped to them."""
        bounded = (
            np.clip(self.scale, 0, MAX_SCALE),
            np.clip(self.offset, -MAX_OFFSET, MAX_OFFSET),
            np.clip(self.residual, -MAX_RESIDUAL, MAX_RESIDUAL),
        )
        arrays = [values.astype("<f2").tobytes() for values in bounded]
        return b"".join((_HEAD, model_digest, *arrays))


def parse_profile(profile: bytes, model_digest: bytes, shape: tuple[int, int, int]) -> Voice:
    """Return the voice of a profile, which may come from anybody.

    Parameters
    ----------
    profile
        The bytes.
    model_digest
        SHA-256 of the model that is to use it.
    shape
        Of the residual with this model.

    Raises
    ------
    UserError
        If it is no profile, was made for another model or its values are out of bounds.
    """
    values_at = len(_HEAD) + _DIGEST_BYTES
    if profile[: len(_HEAD)] != _HEAD:
        raise UserError("it is no voice; make one with 'kouxing adapt'")
    if profile[len(_HEAD) : values_at] != model_digest:
        raise UserError("it was made for another model of lips; run 'kouxing adapt' again")
    num_faps = shape[2]
    sizes = (num_faps, num_faps, int(np.prod(shape)))
    if len(profile) != values_at + 2 * sum(sizes):
        raise UserError(
            f"it has {len(profile)} bytes, expected {values_at + 2 * sum(sizes)}; it is cut off"
        )
    values = np.frombuffer(profile[values_at:], "<f2").astype(np.float32)
    scale, offset, residual = np.split(values, np.cumsum(sizes)[:-1])
    in_bounds = (  # NaN is in none
        (scale >= 0).all()
        and (scale <= MAX_SCALE).all()
        and (np.abs(offset) <= MAX_OFFSET).all()
        and (np.abs(residual) <= MAX_RESIDUAL).all()
    )
    if not in_bounds:
        raise UserError("its values are out of bounds; make it anew with 'kouxing adapt'")
    return Voice(scale=scale, offset=offset, residual=residual.reshape(shape))


def read_profile(path: Path) -> bytes:
    """Return a file's bytes if they can be a profile.

    Raises
    ------
    UserError
        If the file cannot be read, or is too large for a profile.
    """
    try:
        with path.open("rb") as file:
            profile = file.read(MAX_VOICE_BYTES + 1)
    except OSError as error:
        raise UserError(f"the voice {path} cannot be read: {error.strerror}") from None
    if profile[: len(_HEAD)] != _HEAD or len(profile) > MAX_VOICE_BYTES:
        raise UserError(f"{path} is no voice; make one with 'kouxing adapt'")
    return profile
