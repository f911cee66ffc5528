"""What comes back, and the two ZeroMQ parts of every message; see kouxing's PROTOCOL.md."""

from __future__ import annotations

import struct
import sys
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import msgpack

VERSION = 2
NUM_FAPS = 68
Fields = dict[str, Any]
SHAPE_NAMES: dict[str, tuple[str, ...]] = {
    "arkit": tuple(
        """
        browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff
        cheekSquintLeft cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft
        eyeLookDownRight eyeLookInLeft eyeLookInRight eyeLookOutLeft eyeLookOutRight eyeLookUpLeft
        eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight jawForward jawLeft
        jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft
        mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight
        mouthPressLeft mouthPressRight mouthPucker mouthRight mouthRollLower mouthRollUpper
        mouthShrugLower mouthShrugUpper mouthSmileLeft mouthSmileRight mouthStretchLeft
        mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft noseSneerRight
        tongueOut
        """.split()
    ),
    "oculus": tuple("sil PP FF TH DD kk CH SS nn RR aa E ih oh ou".split()),
    "vrm": tuple(
        "aa ih ou ee oh blink blinkLeft blinkRight lookUp lookDown lookLeft lookRight".split()
    ),
}


@dataclass(frozen=True)
class Result:
    """Something about a session at a time of its sound."""

    epoch: int
    """counts the placements of the session; a greater one begins when it moves"""
    sequence: int
    """counts the messages of this publisher"""
    media_time: int
    """samples at 16 kHz since the session's first sample"""

    @property
    def time_s(self) -> float:
        """Seconds since the session's first sample."""
        return self.media_time / 16000


@dataclass(frozen=True)
class FapFrame(Result):
    """The face at ``media_time``."""

    values: array[float]
    """68 values in FAP units, FAP 1 first"""


@dataclass(frozen=True)
class Shapes(Result):
    """The face at ``media_time`` as weights of blend shapes."""

    set: str
    """``arkit``, ``oculus`` or ``vrm``"""
    weights: array[float]
    """0 to 1, in the order of ``SHAPE_NAMES``"""

    @property
    def by_name(self) -> dict[str, float]:
        """The weights by the shapes' names."""
        return dict(zip(SHAPE_NAMES[self.set], self.weights, strict=True))


@dataclass(frozen=True)
class Phone(Result):
    """A recognised phone, whose onset is ``media_time``; the same ``index`` again revises it."""

    index: int
    """counts the phones of an epoch"""
    symbol: str
    """a phone of the session's language"""
    duration: int
    """samples at 16 kHz"""
    confidence: float
    """0 to 1"""
    final: bool
    """onset and duration are measured; else the duration is an estimate"""


@dataclass(frozen=True)
class Speech(Result):
    """Somebody began to speak, or stopped."""

    active: bool


@dataclass(frozen=True)
class Sound(Result):
    """The session's audio, from ``media_time`` on."""

    pcm: bytes
    """16-bit integers, little-endian, 16 kHz, mono"""


# Kind of message, publisher and how its own fields are read, by class.
_READERS: dict[type[Result], tuple[str, str, Callable[[Fields], Fields]]] = {
    FapFrame: ("fap-frame", "faps", lambda body: {"values": floats(body["values"], NUM_FAPS)}),
    Shapes: (
        "shapes",
        "faps",
        lambda body: {"set": body["set"], "weights": floats(body["weights"])},
    ),
    Phone: (
        "phone",
        "phones",
        lambda body: {
            name: body[name] for name in ("index", "symbol", "duration", "confidence", "final")
        },
    ),
    Speech: ("speech", "phones", lambda body: {"active": body["active"]}),
    Sound: ("sound", "phones", lambda body: {"pcm": body["pcm"]}),
}
END = "end-of-faps"
KIND_OF = {cls: kind for cls, (kind, _, _) in _READERS.items()}
PUBLISHER_OF = {END: "faps", **{kind: publisher for kind, publisher, _ in _READERS.values()}}
_CLASS_OF = {kind: cls for cls, kind in KIND_OF.items()}


def encode(kind: str, session: str, fields: Fields) -> list[bytes]:
    """Return the parts of a message."""
    body = {"version": VERSION, "session": session, **fields}
    return [topic(kind, session), msgpack.packb(body)]


def topic(kind: str, session: str) -> bytes:
    """Return the first part of a message; subscriptions are to these."""
    return f"{kind}/{session}/".encode()


def decode(parts: list[bytes]) -> tuple[str, Fields] | None:
    """Return kind and fields of a message; None if it is none of this version."""
    try:
        name, body = parts
        fields = {
            "session": "", "epoch": 0, "sequence": 0, "media_time": 0, **msgpack.unpackb(body)
        }  # fmt: skip
        return (name.decode().partition("/")[0], fields) if fields["version"] == VERSION else None
    except (ValueError, TypeError, KeyError, msgpack.UnpackException):
        return None


def result(kind: str, fields: Fields) -> Result | None:
    """Return what a publisher's message says; None if a field is missing or wrong."""
    cls = _CLASS_OF[kind]
    common = {name: fields[name] for name in ("epoch", "sequence", "media_time")}
    try:
        return cls(**common, **_READERS[cls][2](fields))
    except (KeyError, TypeError, ValueError, struct.error):
        return None


def floats(data: bytes, count: int | None = None) -> array[float]:
    """Return little-endian float32."""
    values = array("f", data)
    if count not in (None, len(values)):
        raise ValueError(f"expected {count} values, got {len(values)}")
    if sys.byteorder == "big":
        values.byteswap()
    return values


def kinds_of(classes: Iterable[type[Result]]) -> set[str]:
    """Return the kinds of messages that bring some results, and the end."""
    return {END, *(KIND_OF[cls] for cls in classes)}
