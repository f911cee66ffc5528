"""Parses and encodes messages on the gateway's WebSockets; ``proto/GATEWAY.md`` specifies them.

Binary messages are little-endian: u8 type, 3 zero bytes, u32 epoch, f64 media time (samples at
16 kHz), then the payload at an offset that is a multiple of four.
"""

import json
import struct
from collections.abc import Collection, Mapping
from typing import Annotated, Any, TypeVar

import msgspec
from kouxing_client.field_types import SessionName, full_match
from kouxing_client.options import MAX_RATE_HZ
from msgspec import Meta, Struct

from kouxing.services.gateway.messages.pcm_format import (
    MAX_OBJECT_BYTES,
    PcmFormat,
    WrongFormat,
    check_text,
)
from kouxing.services.lip_models import lip_model_names
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import DEFAULT_HOLD_S, check_expressions
from kouxing.shared.files.user_file import parse_json
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.field_errors import describe_field_error
from kouxing.shared.wire.session import MouthProfile
from kouxing.shared.wire.speech import AcousticModelName

_Kind = TypeVar("_Kind")
_HEADER = struct.Struct("<B3xId")
FAP_TYPE = 1  # payload: 68 float32, FAP units
SOUND_TYPE = 2  # payload: int16, 16 kHz mono
REST_TYPE = 3  # payload as for FAP_TYPE: the face while no session moves it
SHAPES_TYPE = 4  # payload: float32 weights of a shape set, for a frame
REST_SHAPES_TYPE = 5  # payload: float32 weights of a shape set, for the face at rest

MAX_SKIPPED_SAMPLES = 600 * MAX_RATE_HZ  # 10 minutes
MAX_SHOWN = 40  # characters of a client's text in an error
# The face settings that a browser can change; the query of its address selects shapes.
FACE_SETTINGS = tuple(name for name in FaceSettings.__struct_fields__ if name != "shapes")
_FLAGS = ("ahead", "flush", "last")  # true or false; 1 and 0 too, as in version 0.1.0
_FORMAT_FIELDS = PcmFormat.__struct_fields__
COMMANDS = ("skip", "flush", "last", *FACE_SETTINGS)  # that a microphone client may send
CHANNEL_COMMANDS = ("flush", *FACE_SETTINGS)  # that a WebRTC client may send
VIEWER_COMMANDS = ("follow", "play", "avatar", "format", *FACE_SETTINGS)
FORMATS = ("binary", "json", "msgpack")  # formats of blendshapes
# names in version 0.1.0, which are still accepted
_OLD_NAMES = {"lips": "lip_model", "express": "expressions", "eof": "last"}


def encode_binary(message_type: int, epoch: int, media_time: int, payload: bytes) -> bytes:
    """Return a binary message."""
    return _HEADER.pack(message_type, epoch, media_time) + payload


def encode_json(message_type: str, **fields: object) -> str:
    """Return a JSON message."""
    return msgspec.json.encode({"type": message_type, **fields}).decode()


def encode_error(reason: str, code: str = "refused", retry_after_s: float = 0.0) -> str:
    """Return an error message; ``retry_after_s`` is left out if it is 0 (unknown)."""
    retry = {"retry_after_s": retry_after_s} if retry_after_s else {}
    return encode_json("error", code=code, text=reason, **retry)


class MicrophoneOptions(PcmFormat, frozen=True, kw_only=True):
    """The first message of a microphone."""

    ahead: bool = False  # whether audio may arrive faster than real time
    mouth_profile: MouthProfile = b""  # profile of the speaker; empty: average speaker
    language: Annotated[str, Meta(max_length=64)] = ""  # empty: language of the recognizer


def parse_microphone_options(message: str) -> tuple[MicrophoneOptions, str]:
    """Return the first message of a microphone, and an error about unknown fields, or "".

    Raises ``UserError`` if a field is missing or out of range; the text names the field.
    """
    fields = parse_object(message)
    problem = find_unknown(fields, MicrophoneOptions.__struct_fields__)
    if fields.get("sample_rate_hz") is None:
        raise UserError("; ".join(filter(None, ("sample_rate_hz is missing", problem))))
    return _convert(_with_flags(fields), MicrophoneOptions), problem


class MicrophoneCommand(Struct, frozen=True, kw_only=True):
    """A command between the chunks of a browser's microphone."""

    flush: bool = False  # whether to drop audio whose face is not shown yet
    last: bool = False  # whether no more audio follows
    skip: Annotated[int, Meta(ge=0, le=MAX_SKIPPED_SAMPLES)] = 0  # samples that the client skipped
    face: dict[str, Any]  # settings to change
    problem: str = ""  # error about fields that are ignored


def parse_command(
    message: str, pcm_format: PcmFormat | None = None, known: Collection[str] = COMMANDS
) -> MicrophoneCommand:
    """Parse a later text message of a microphone, in which the fields ``known`` are allowed.

    Raises ``WrongFormat`` if the message describes audio of another format than ``pcm_format``, or
    looks like base64. Raises ``UserError`` if it is not a JSON object, or a field is out of range.
    """
    check_text(message)
    fields = parse_command_fields(message)
    for name in _FORMAT_FIELDS:
        if name in fields and pcm_format and fields[name] != getattr(pcm_format, name):
            raise WrongFormat(f"{name} cannot change during a session; open another connection")
    options = MicrophoneOptions.__struct_fields__
    problem = find_unknown([name for name in fields if name not in options], known)
    for name in fields:
        if name in options and name not in _FORMAT_FIELDS:
            problem = f"{name} cannot change during a session; open another connection"
    settings = parse_face_settings(fields)
    face = {name: getattr(settings, name) for name in FACE_SETTINGS} if settings else {}
    fields = {**_with_flags(fields), "face": face, "problem": problem}
    return _convert(fields, MicrophoneCommand)


def _with_flags(fields: Mapping[str, object]) -> dict[str, object]:
    """Return the fields of a message, in which 1 and 0 of a flag are replaced by true and false."""
    return {
        name: bool(value) if name in _FLAGS and value in (0, 1) else value
        for name, value in fields.items()
    }


class ViewerCommand(Struct, frozen=True, kw_only=True):
    """A command of a viewer."""

    follow: SessionName | None = None  # session to show; empty: the newest
    play: Annotated[str, full_match("(sample)")] | None = None
    avatar: list[list[Annotated[str, Meta(max_length=128)]]] | None = None  # shapes of each mesh
    format: Annotated[str, full_match(f"({'|'.join(FORMATS)})")] = FORMATS[0]  # the weights' format
    face: FaceSettings | None = None  # settings to change
    problem: str = ""  # error about fields that are ignored


def parse_viewer_command(message: str) -> ViewerCommand:
    """Parse a command of a viewer.

    Raises ``UserError`` if the message is not a JSON object, or a field is invalid.
    """
    fields = parse_command_fields(message)
    face = parse_face_settings(fields)
    problem = find_unknown(fields, VIEWER_COMMANDS)
    return _convert({**fields, "face": face, "problem": problem}, ViewerCommand)


def parse_face_settings(fields: Mapping[str, object]) -> FaceSettings | None:
    """Return the face settings of a command; None if it contains none.

    Null and an empty ``lip_model`` do not count. Raises ``UserError`` if a value is invalid; the
    text names the field and the allowed values.
    """
    given = {name: fields[name] for name in FACE_SETTINGS if fields.get(name) is not None}
    if given.get("lip_model") == "":
        del given["lip_model"]
    if not given:
        return None
    if given.keys() == {"hold_s"}:
        raise UserError("hold_s is how long expressions last; send it with expressions")
    if isinstance(expressions := given.get("expressions"), dict):
        check_expressions(expressions, given.get("hold_s", DEFAULT_HOLD_S))
    for name, allowed in (("lip_model", lip_model_names()), ("acoustic", [*AcousticModelName])):
        if name in given and given[name] not in allowed:
            value = _shorten(json.dumps(given[name], ensure_ascii=False))
            raise UserError(f"{name} is {value}; it must be {' or '.join(allowed)}")
    return _convert(given, FaceSettings)


def _convert(fields: Mapping[str, object], kind: type[_Kind]) -> _Kind:
    """Convert the fields of a message; raises ``UserError`` if one is invalid."""
    try:
        return msgspec.convert(fields, kind)
    except msgspec.ValidationError as error:
        raise UserError(describe_field_error(error)) from None


def find_unknown(fields: Collection[str], known: Collection[str]) -> str:
    """Return an error about a message's unknown fields; empty if all are known."""
    unknown = [name for name in fields if name not in known]
    if not unknown:
        return ""
    noun = "field" if len(unknown) == 1 else "fields"
    return f"unknown {noun} {_shorten(', '.join(unknown))}; use {', '.join(known)}"


def _shorten(text: str) -> str:
    """Return a client's text, shortened for an error."""
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 1] + "…"


def parse_command_fields(message: str) -> dict[str, object]:
    """Return the fields of a command; raises ``UserError`` as :func:`parse_object`."""
    return {_OLD_NAMES.get(name, name): value for name, value in parse_object(message).items()}


def parse_object(message: str | bytes) -> dict[str, object]:
    """Return the object of a JSON message.

    Raises ``UserError`` if the message is not a JSON object, or too long.
    """
    if len(message) > MAX_OBJECT_BYTES:
        raise UserError(f"a JSON message is longer than {MAX_OBJECT_BYTES >> 10} KiB; shorten it")
    try:
        fields = parse_json(message)
        json.dumps(fields, ensure_ascii=False).encode()  # an error can contain any of its texts
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise UserError("expected a JSON object")
    return fields
