"""Parses and encodes messages on the gateway's WebSockets; ``proto/GATEWAY.md`` specifies them.

Binary messages are little-endian: u8 type, 3 zero bytes, u32 epoch, f64 media time (samples at
16 kHz), then the payload at an offset that is a multiple of four.
"""

import base64
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from kouxing.services.gateway.pcm_format import MAX_OBJECT_BYTES, RATES_HZ, PcmFormat, check_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import DEFAULT_HOLD_S, check_expressions
from kouxing.shared.face.lip_constants import MAX_MOUTH_PROFILE_BYTES
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
MAX_SKIPPED = 600 * RATES_HZ[1]  # samples; 10 minutes
# What a browser can change; the query of its address selects shapes.
FACE_SETTINGS = tuple(name for name in FaceSettings.__struct_fields__ if name != "shapes")
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


def parse_microphone_options(message: str) -> MicrophoneOptions:
    """Parse the first message of a microphone.

    Raises ``UserError`` if a field is missing or out of range; the text names the field.
    """
    fields = parse_object(message)
    pcm_format = PcmFormat(
        sample_rate_hz=fields.get("sample_rate_hz"),  # type: ignore[arg-type] # checked there
        num_channels=fields.get("num_channels", 1),  # type: ignore[arg-type]
        encoding=fields.get("encoding", "s16le"),  # type: ignore[arg-type]
    )
    return MicrophoneOptions(
        pcm_format=pcm_format,
        is_ahead=bool(fields.get("ahead")),
        mouth_profile=_parse_mouth_profile(fields.get("mouth_profile", "")),
        language=_parse_language(fields.get("language", "")),
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


def parse_command(message: str, pcm_format: PcmFormat | None = None) -> MicrophoneCommand:
    """Parse a later text message of a microphone.

    Raises ``UserError`` if the message is not a JSON object, a field is out of range, or it
    describes audio of another format than ``pcm_format``.
    """
    check_text(message)
    fields = parse_command_fields(message)
    for name in ("sample_rate_hz", "num_channels", "encoding"):
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
    )


def parse_face_settings(fields: Mapping[str, object]) -> FaceSettings | None:
    """Return the face settings of a command; None if it contains none.

    Raises ``UserError`` if a value is out of range.
    """
    given = {name: fields[name] for name in FACE_SETTINGS if fields.get(name) is not None}
    if isinstance(expressions := given.get("expressions"), dict):
        check_expressions(expressions, given.get("hold_s", DEFAULT_HOLD_S))
    try:
        settings = msgspec.convert(given, FaceSettings)
    except msgspec.ValidationError as error:
        raise UserError(str(error)) from None
    if settings.acoustic not in (None, *AcousticModelName):
        raise UserError("acoustic must be full or light")
    return settings if given.keys() - {"hold_s"} else None


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
    except ValueError:
        fields = None
    if not isinstance(fields, dict):
        raise UserError("expected a JSON object")
    return fields
