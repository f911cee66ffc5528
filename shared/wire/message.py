"""The fields that every message has, and the types of the fields.

A message is two ZeroMQ parts: the topic ``<kind>/<session>/`` and a msgpack map of the fields of
its class. The kind is the class name in kebab-case: ``FapFrame`` is a ``fap-frame``.
``proto/PROTOCOL.md`` is the authority. A new optional field or a new kind keeps the version; any
other change needs a new version.
"""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from msgspec import Meta, Struct

from kouxing.shared.face.faps import MASK_BYTES, MOUTH_FAPS, NUM_FAPS
from kouxing.shared.name_rules import NAME_OR_EMPTY

VERSION = 3
DOCUMENT = "proto/PROTOCOL.md"
MAX_AUDIO_BYTES = 64 * 1024
MAX_COMMAND_BYTES = 256 * 1024  # a heartbeat that names 2000 sessions
MAX_MESSAGE_BYTES = 1024 * 1024

Version = Annotated[int, Meta(ge=1, le=65535)]
SessionName = Annotated[str, Meta(pattern=f"^{NAME_OR_EMPTY}$")]
Name = Annotated[str, Meta(min_length=1, max_length=128)]
Text = Annotated[str, Meta(max_length=2000)]
Count = Annotated[int, Meta(ge=0, le=2**53)]
Samples = Annotated[int, Meta(ge=0, le=2**53)]  # at 16 kHz
Seconds = Annotated[float, Meta(ge=0)]
Milliseconds = Annotated[float, Meta(ge=0)]
Probability = Annotated[float, Meta(ge=0, le=1)]
Endpoint = Annotated[str, Meta(max_length=256)]
EndpointMap = Annotated[dict[Name, Endpoint], Meta(max_length=16)]
FapValues = Annotated[bytes, Meta(min_length=4 * NUM_FAPS, max_length=4 * NUM_FAPS)]
FapMask = Annotated[bytes, Meta(min_length=MASK_BYTES, max_length=MASK_BYTES)]
LipValues = Annotated[bytes, Meta(min_length=4 * len(MOUTH_FAPS), max_length=4 * len(MOUTH_FAPS))]


MESSAGES: dict[str, type[Message]] = {}  # every class by its kind, once its module is imported


class Message(Struct, frozen=True, kw_only=True):
    """The fields that every message has."""

    kind: ClassVar[str]  # the class name in kebab-case
    published_at: ClassVar[str | None] = None  # name of the endpoint

    version: Version = VERSION
    session: SessionName = ""  # empty: the message concerns no session
    epoch: Count = 0  # counts the placements of a session
    sequence: Count = 0  # grows by one per sender, socket and session
    media_time: Samples = 0  # samples at 16 kHz since the session's first sample

    def __init_subclass__(cls) -> None:
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()
        MESSAGES[cls.kind] = cls
