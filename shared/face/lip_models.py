"""What clients choose of lips: the lip model by its name, and a speaker's mouth profile."""

from __future__ import annotations

from enum import StrEnum

MAX_MOUTH_PROFILE_BYTES = 64 * 1024


class LipModelName(StrEnum):
    """What moves the mouth."""

    DYNAMIC_VISEMES = "dynamic-visemes"  # the recognised phones
    LEARNT = "learnt"  # the sound itself
    FERGUSON = "ferguson"  # one opening, by the phones and the sound's energy


DEFAULT_LIP_MODEL = LipModelName.LEARNT
