"""The names of the lip models, for whoever chooses one."""

from __future__ import annotations

from enum import StrEnum


class LipModelName(StrEnum):
    """What moves the mouth."""

    DYNAMIC_VISEMES = "dynamic-visemes"  # the recognised phones
    LEARNT = "learnt"  # the sound itself
