"""The moving face."""

from __future__ import annotations

from dataclasses import dataclass

from kouxing.shared.wire.message import FapMask, FapValues, Message, Name, ShapeWeights


@dataclass(frozen=True, slots=True, kw_only=True)
class FapFrame(Message):
    """The face that belongs to the sound at media_time."""

    values: FapValues  # 68 float32, little-endian, in FAP units
    mask: FapMask  # bit i of the little-endian integer: FAP i + 1 is set


@dataclass(frozen=True, slots=True, kw_only=True)
class Shapes(Message):
    """The face of the ``fap-frame`` with the same sequence and media_time, as weights of shapes."""

    set: Name  # a ShapeSetName, or one of a later build
    weights: ShapeWeights  # float32, little-endian, 0 to 1, in the order of the set's names


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfFaps(Message):
    """The last FAP frame of the session came before this."""
