"""Parses and encodes messages on the gateway's WebSockets; ``proto/GATEWAY.md`` specifies them.

Binary messages are little-endian: u8 type, 3 zero bytes, u32 epoch, f64 media time (samples at
16 kHz), then the payload at an offset that is a multiple of four.
"""

import base64
import json
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import msgspec
from kouxing_client.options import MAX_RATE_HZ

from kouxing.services.gateway.pcm_format import MAX_OBJECT_BYTES, PcmFormat, check_text
from kouxing.services.lip_models import lip_model_names
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import (
    DEFAULT_HOLD_S,
    MAX_EXPRESSIVENESS,
    MAX_HOLD_S,
    MIN_EXPRESSIVENESS,
    check_expressions,
)
from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.name_rules import NAME_RULE
from kouxing.shared.user_file import parse_json
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.speech import AcousticModelName

_HEADER = struct.Struct("<B3xId")
FAP_TYPE = 1  # payload: 68 float32, FAP units
SOUND_TYPE = 2  # payload: int16, 16 kHz mono
REST_TYPE = 3  # payload as for FAP_TYPE: the face while no session moves it
SHAPES_TYPE = 4  # payload: float32 weights of a shape set, for a frame
REST_SHAPES_TYPE = 5  # payload: float32 weights of a shape set, for the face at rest

MAX_LANGUAGE_LETTERS = 64
MAX_SKIPPED = 600 * MAX_RATE_HZ  # samples; 10 minutes
MAX_SHOWN = 40  # characters of a client's text in an error
# The face settings that a browser can change, and their values in words; the query of its address
# selects shapes.
FACE_SETTINGS = {
    "lip_model": f"the name of a lip model: {', '.join(lip_model_names())}",
    "acoustic": " or ".join(AcousticModelName),
    "expressiveness": f"a number from {MIN_EXPRESSIVENESS:g} to {MAX_EXPRESSIVENESS:g}",
    "feeling": "a number from 0 to 1",
    "still": "true or false",
    "eye_contact": "true or false",
    "listen_to": f'the name of a session, or "" for none; {NAME_RULE}',
    "listening": "true or false",
    "expressions": "an object that maps names to strengths from 0 to 1",
    "hold_s": f"a number from 0 to {MAX_HOLD_S:g}",
}
_FORMAT_FIELDS = ("sample_rate_hz", "num_channels", "encoding")
OPTIONS = (*_FORMAT_FIELDS, "ahead", "mouth_profile", "language")  # of a microphone
COMMANDS = ("skip", "flush", "last", *FACE_SETTINGS)  # of a microphone
# names in version 0.1.0, which are still accepted
_OLD_NAMES = {"lips": "lip_model", "express": "expressions", "eof": "last"}


def binary(message_type: int, epoch: int, media_time: int, payload: bytes) -> bytes:
    """Return a binary message."""
    return _HEADER.pack(message_type, epoch, media_time) + payload


def text(message_type: str, **fields: object) -> str:
    """Return a JSON message."""
    return msgspec.json.encode({"type": message_type, **fields}).decode()


def error_text(reason: str, code: str = "refused", retry_after_s: float = 0.0) -> str:
    """Return an error message; ``retry_after_s`` is left out if it is 0 (unknown)."""
    retry = {"retry_after_s": retry_after_s} if retry_after_s else {}
    return text("error", code=code, text=reason, **retry)


@dataclass(frozen=True, slots=True, kw_only=True)
class MicrophoneOptions:
    """The first message of a microphone."""

    pcm_format: PcmFormat
    is_ahead: bool  # audio may arrive faster than real time
    mouth_profile: bytes  # profile of the speaker; empty: average speaker
    language: str  # spoken language; empty: language of the recognizer
    problem: str  # error about unknown fields, which are ignored; empty: all are known


def parse_microphone_options(message: str) -> MicrophoneOptions:
    """Parse the first message of a microphone.

    Raises ``UserError`` if a field is missing or out of range; the text names the field.
    """
    fields = parse_object(message)
    problem = find_unknown(fields, OPTIONS)
    if fields.get("sample_rate_hz") is None:
        raise UserError("; ".join(filter(None, ("sample_rate_hz is missing", problem))))
    pcm_format = PcmFormat(
        sample_rate_hz=fields["sample_rate_hz"],  # type: ignore[arg-type] # checked there
        num_channels=fields.get("num_channels", 1),  # type: ignore[arg-type]
        encoding=fields.get("encoding", "s16le"),  # type: ignore[arg-type]
    )
    return MicrophoneOptions(
        pcm_format=pcm_format,
        is_ahead=bool(fields.get("ahead")),
        mouth_profile=_parse_mouth_profile(fields.get("mouth_profile", "")),
        language=_parse_language(fields.get("language", "")),
        problem=problem,
    )


def _parse_language(field: object) -> str:
    if not isinstance(field, str) or len(field) > MAX_LANGUAGE_LETTERS:
        raise UserError("language must be auto, or the code of a language such as de")
    return field


def _parse_mouth_profile(field: object) -> bytes:
    try:
        profile = base64.b64decode(field, validate=True) if isinstance(field, str) else None
    except ValueError:
        profile = None
    if profile is None or len(profile) > MAX_MOUTH_PROFILE_BYTES:
        limit_kib = MAX_MOUTH_PROFILE_BYTES >> 10
        raise UserError(f"mouth_profile must be at most {limit_kib} KiB in base64")
    return profile


@dataclass(frozen=True, slots=True, kw_only=True)
class MicrophoneCommand:
    """A command between the chunks of a browser's microphone."""

    flush: bool  # interrupt: drop audio whose face is not shown yet
    last: bool  # no more audio follows
    num_skipped: int  # samples per channel that the client skipped
    face: dict[str, object]  # settings to change
    problem: str  # error about unknown fields, which are ignored; empty: all are known


def parse_command(message: str, pcm_format: PcmFormat | None = None) -> MicrophoneCommand:
    """Parse a later text message of a microphone.

    Raises ``UserError`` if the message is not a JSON object, a field is out of range, or it
    describes audio of another format than ``pcm_format``.
    """
    check_text(message)
    fields = parse_command_fields(message)
    for name in _FORMAT_FIELDS:
        if name in fields and pcm_format and fields[name] != getattr(pcm_format, name):
            raise UserError(f"{name} cannot change during a session; open another connection")
    num_skipped = fields.get("skip", 0)
    if type(num_skipped) is not int or not 0 <= num_skipped <= MAX_SKIPPED:
        raise UserError(f"skip must be an integer from 0 to {MAX_SKIPPED}")
    face = parse_face_settings(fields)
    return MicrophoneCommand(
        flush=bool(fields.get("flush")),
        last=bool(fields.get("last")),
        num_skipped=num_skipped,
        face={name: getattr(face, name) for name in FACE_SETTINGS} if face else {},
        problem=find_unknown([name for name in fields if name not in _FORMAT_FIELDS], COMMANDS),
    )


def parse_face_settings(fields: Mapping[str, object]) -> FaceSettings | None:
    """Return the face settings of a command; None if it contains none.

    Null and an empty ``lip_model`` do not count. Raises ``UserError`` if a value is invalid; the
    text names the field, its value and the allowed values.
    """
    given = {name: fields[name] for name in FACE_SETTINGS if fields.get(name) is not None}
    if given.get("lip_model") == "":
        del given["lip_model"]
    if given.keys() == {"hold_s"}:
        raise UserError("hold_s is how long expressions last; send it with expressions")
    if isinstance(expressions := given.get("expressions"), dict):
        check_expressions(expressions, given.get("hold_s", DEFAULT_HOLD_S))
    for name, value in given.items():
        if not _is_setting(name, value):
            shown = _shorten(json.dumps(value, ensure_ascii=False))
            raise UserError(f"{name} is {shown}; it must be {FACE_SETTINGS[name]}")
    return msgspec.convert(given, FaceSettings) if given else None


def _is_setting(name: str, value: object) -> bool:
    """Return whether a face setting can have this value."""
    if name == "lip_model":
        return value in lip_model_names()
    if name == "acoustic":
        return value in [*AcousticModelName]
    try:
        msgspec.convert({name: value}, FaceSettings)
    except msgspec.ValidationError:
        return False
    return True


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
