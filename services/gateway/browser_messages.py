"""Parses and encodes messages on the gateway's WebSockets; ``proto/GATEWAY.md`` specifies them.

Binary messages are little-endian: u8 type, 3 zero bytes, u32 epoch, f64 media time (samples at
16 kHz), then the payload at an offset that is a multiple of four.
"""

import base64
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from kouxing.services.gateway.pcm_format import MAX_OBJECT_BYTES, RATES_HZ, PcmFormat, check_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import (
    DEFAULT_HOLD_S,
    MAX_EXPRESSIVENESS,
    MIN_EXPRESSIVENESS,
    check_amount,
    check_expressions,
)
from kouxing.shared.face.lip_constants import LIP_MODEL_NAME, MAX_MOUTH_PROFILE_BYTES
from kouxing.shared.name_rules import is_name
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
    eof: bool  # no more audio follows
    num_skipped: int  # samples per channel that the client skipped
    lip_model: str  # the new lip model; empty: no change


def parse_command(message: str, pcm_format: PcmFormat | None = None) -> MicrophoneCommand:
    """Parse a later text message of a microphone.

    Raises ``UserError`` if the message is not a JSON object, a field is out of range, or it
    describes audio of another format than ``pcm_format``.
    """
    check_text(message)
    fields = parse_object(message)
    for name in ("sample_rate_hz", "num_channels", "encoding"):
        if name in fields and pcm_format and fields[name] != getattr(pcm_format, name):
            raise UserError(f"{name} cannot change during a session; open another connection")
    num_skipped = fields.get("skip", 0)
    if type(num_skipped) is not int or not 0 <= num_skipped <= MAX_SKIPPED:
        raise UserError(f"skip must be an integer from 0 to {MAX_SKIPPED}")
    return MicrophoneCommand(
        flush=bool(fields.get("flush")),
        eof=bool(fields.get("eof")),
        num_skipped=num_skipped,
        lip_model=_parse_lip_model(fields),
    )


def _parse_lip_model(fields: Mapping[str, object]) -> str:
    lip_model = fields.get("lips", "")
    if not isinstance(lip_model, str) or (lip_model and not LIP_MODEL_NAME.fullmatch(lip_model)):
        raise UserError("lips must be the name of a lip model")
    return lip_model


def parse_face_settings(fields: Mapping[str, object]) -> FaceSettings | None:
    """Return the face settings of a viewer's command; None if it contains none.

    Raises ``UserError`` if a name is unknown or a number is out of range.
    """
    expressions, hold_s = fields.get("express"), fields.get("hold_s", DEFAULT_HOLD_S)
    settings: dict[str, Any] = {}
    if lip_model := _parse_lip_model(fields):
        settings["lip_model"] = lip_model
    if expressions is not None:
        if not isinstance(expressions, dict):
            raise UserError("express must be an object that maps names to strengths")
        check_expressions(expressions, hold_s)
        settings.update(expressions=expressions, hold_s=hold_s)
    if (acoustic := fields.get("acoustic")) is not None:
        if acoustic not in [*AcousticModelName]:
            raise UserError("acoustic must be full or light")
        settings["acoustic"] = acoustic
    limits = {"expressiveness": (MIN_EXPRESSIVENESS, MAX_EXPRESSIVENESS), "feeling": (0.0, 1.0)}
    for name, (lowest, highest) in limits.items():
        if (amount := fields.get(name)) is not None:
            settings[name] = check_amount(name, amount, lowest, highest)
    for name in ("still", "eye_contact", "listening"):
        if (value := fields.get(name)) is not None:
            if not isinstance(value, bool):
                raise UserError(f"{name} must be true or false")
            settings[name] = value
    if (listen_to := fields.get("listen_to")) is not None:
        if not isinstance(listen_to, str) or (listen_to and not is_name(listen_to)):
            raise UserError("listen_to must be the name of a session, or empty")
        settings["listen_to"] = listen_to
    return FaceSettings(**settings) if settings else None


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
