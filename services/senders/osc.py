"""Open Sound Control 1.0: a face as messages of one number each.

======================  =====  ====================================================================
address                 types  value
======================  =====  ====================================================================
``/kouxing/time``       f      media time, seconds; it goes on while the face is at rest
``/kouxing/head``       fff    degrees down, to the head's left, and tilted to its right
``/kouxing/jawOpen`` …  f      weight of a shape from 0 to 1, one message each
======================  =====  ====================================================================

``?prefix=`` takes the place of ``/kouxing/``. All messages of a frame come in bundles to be shown
at once, each small enough for one packet of the network.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from functools import lru_cache

from pythonosc.osc_message_builder import build_msg

from kouxing.services.senders.face import Face
from kouxing.services.senders.target import Target

MAX_BYTES = 1500 - 28  # of a datagram: an Ethernet frame without the headers of IP and UDP
_HEADER = b"#bundle\0" + struct.pack(">Q", 1)  # to be shown at once


def encode(face: Face, target: Target) -> Iterator[bytes]:
    """Yield the datagrams of a frame."""
    weights = face.weights(target.shapes, is_mouth_only=target.is_mouth_only)
    messages = [message(f"{target.prefix}time", face.time_s)]
    if not target.is_mouth_only:
        messages.append(message(f"{target.prefix}head", *map(math.degrees, face.head)))
    messages += [message(target.prefix + name, value) for name, value in weights.items()]
    return bundles(messages)


def message(address: str, *arguments: str | int | float) -> bytes:
    """Return a message; integers are sent as int32, other numbers as float32.

    The numbers stand behind the texts.
    """
    numbers = [each for each in arguments if not isinstance(each, str)]
    texts = arguments[: len(arguments) - len(numbers)]
    kinds = "".join("i" if isinstance(each, int) else "f" for each in numbers)
    return _begin(address, texts, kinds) + struct.pack(f">{kinds}", *numbers)


@lru_cache(maxsize=1024)
def _begin(address: str, texts: tuple[str, ...], kinds: str) -> bytes:
    """Return a message without its numbers, which are the same in each frame."""
    numbers = [0 if kind == "i" else 0.0 for kind in kinds]
    whole = build_msg(address, [*texts, *numbers]).dgram
    return whole[: len(whole) - 4 * len(numbers)]


def bundles(messages: Iterable[bytes]) -> Iterator[bytes]:
    """Yield as few bundles with all messages in their order as datagrams may carry."""
    bundle = _HEADER
    for each in messages:
        part = struct.pack(">i", len(each)) + each
        if len(bundle) + len(part) > MAX_BYTES:
            yield bundle
            bundle = _HEADER
        bundle += part
    yield bundle
