"""Encodes messages to the two parts of a ZeroMQ message, and decodes them.

The first part is the topic, which subscriptions match by prefix; the second is a msgpack map. Audio
and FAP values are fields of the map. They are small, usually under 2 KiB, so copying them costs
less than separate parts.
"""

from collections.abc import Sequence

import msgspec
from kouxing_client.field_types import Name, Version
from kouxing_client.messages import VERSION, Message, topic

from kouxing.shared.wire.field_errors import describe_field_error
from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.message import DOCUMENT

_MAX_TOPIC_BYTES = 96  # the rest is not read; the longest kind and session have 81


class BadMessage(Exception):
    """The parts are not a message.

    ``reason`` is a short word for counters, ``version`` the sender's protocol version, and
    ``request`` the name of the request, if it can be read.
    """

    def __init__(self, reason: str, text: str, version: int = VERSION) -> None:
        super().__init__(text)
        self.reason = reason
        self.version = version
        self.request: str | None = None


class _VersionOnly(msgspec.Struct):
    version: Version = VERSION


class _RequestOnly(msgspec.Struct):
    request: Name | None = None


_ENCODER = msgspec.msgpack.Encoder()
_DECODERS = {kind: msgspec.msgpack.Decoder(cls) for kind, cls in MESSAGES.items()}
_VERSION_DECODER = msgspec.msgpack.Decoder(_VersionOnly)
_REQUEST_DECODER = msgspec.msgpack.Decoder(_RequestOnly)
_UNREADABLE = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


def encode(message: Message) -> list[bytes]:
    """Return the two parts of a message.

    In an answer to a program of another version, empty fields are omitted. They would be null,
    which version 2 does not accept.
    """
    body: object = message
    if message.version != VERSION:
        fields = msgspec.structs.asdict(message)
        body = {name: value for name, value in fields.items() if value is not None}
    return [topic(message.kind, message.session), _ENCODER.encode(body)]


def encoded_size(structure: object) -> int:
    """Return the size of a structure in the body of a message, bytes."""
    return len(_ENCODER.encode(structure))


def decode(parts: Sequence[bytes]) -> Message:
    """Decode a message; unknown fields are ignored.

    Raises ``BadMessage`` if the number of parts is wrong, the kind or version is unknown, or a
    field has the wrong type or range.
    """
    if len(parts) != 2:
        raise BadMessage("parts", f"expected 2 parts (topic, body), got {len(parts)}")
    try:
        return _decode(*parts)
    except BadMessage as error:
        error.request = _read_request(parts[1])
        raise


def _decode(label: bytes, body: bytes) -> Message:
    try:
        kind, session, rest = label[:_MAX_TOPIC_BYTES].decode("ascii").split("/")
    except ValueError:
        raise BadMessage("topic", "the topic is not '<kind>/<session>/'") from None
    decoder = _DECODERS.get(kind)
    if decoder is None or rest:
        _check_version(kind, _read_version(body))
        raise BadMessage(
            "kind",
            f"unknown message kind {kind[:32]!r}; {DOCUMENT} lists the kinds of version {VERSION}",
        )
    try:
        message: Message = decoder.decode(body)
    except _UNREADABLE as error:
        _check_version(kind, _read_version(body))
        raise BadMessage("body", f"{kind}: {describe_field_error(error)}") from None
    _check_version(kind, message.version)
    if message.session != session:
        raise BadMessage("topic", "topic and body name different sessions")
    return message


def _check_version(kind: str, version: int) -> None:
    if version != VERSION:
        raise BadMessage(
            "version",
            f"{kind[:32]!r} is a message of protocol version {version}, but its receiver uses "
            f"version {VERSION}: upgrade the {'sender' if version < VERSION else 'receiver'} "
            f"({DOCUMENT} describes version {VERSION})",
            version,
        )


def _read_version(body: bytes) -> int:
    try:
        return _VERSION_DECODER.decode(body).version
    except _UNREADABLE:
        return VERSION


def _read_request(body: bytes) -> str | None:
    try:
        return _REQUEST_DECODER.decode(body).request
    except _UNREADABLE:
        return None
