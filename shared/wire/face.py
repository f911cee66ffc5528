"""The moving face."""

from __future__ import annotations

from dataclasses import dataclass

from shared.wire.message import FapMask, FapValues, Message


@dataclass(frozen=True, slots=True, kw_only=True)
class FapFrame(Message):
    """The face that belongs to the sound at media_time."""

    values: FapValues  # 68 float32, little-endian, in FAP units
    mask: FapMask  # bit i of the little-endian integer: FAP i + 1 is set


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfFaps(Message):
    """The last FAP frame of the session came before this."""
