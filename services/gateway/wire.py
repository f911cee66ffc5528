"""What goes over the browser's WebSockets; ``proto/GATEWAY.md`` describes it.

Binary messages, little-endian: u8 type, 3 zero bytes, u32 epoch, f64 media time (samples at
16 kHz), then the payload, which so begins on a multiple of four.
"""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import dataclass

from kouxing.services.gateway.sound_format import RATES_HZ, SoundFormat, check_text
from kouxing.shared.errors import UserError
from kouxing.shared.face.expressions import DEFAULT_HOLD_S, check_expressions, check_expressiveness
from kouxing.shared.face.lip_models import MAX_MOUTH_PROFILE_BYTES, LipModelName

_HEADER = struct.Struct("<B3xId")
FAP_TYPE = 1  # payload: 68 float32, FAP units
SOUND_TYPE = 2  # payload: int16, 16 kHz mono
REST_TYPE = 3  # payload: as of FAP_TYPE, for who sees no frames of a session
SHAPES_TYPE = 4  # payload: float32 weights of a set of shapes, of a frame
REST_SHAPES_TYPE = 5  # payload: likewise of the face at rest

MAX_SKIPPED = 600 * RATES_HZ[1]  # samples; 10 minutes


def binary(kind: int, epoch: int, media_time: int, payload: bytes) -> bytes:
    """Return a binary message."""
    return _HEADER.pack(kind, epoch, media_time) + payload


def text(kind: str, **fields: object) -> str:
    """Return a JSON message."""
    return json.dumps({"type": kind, **fields}, ensure_ascii=False)


def error_text(reason: str, code: str = "refused", retry_after_s: float = 0.0) -> str:
    """Return the message that something was refused, why, and when to try again; 0: unknown."""
    when = {"retry_after_s": retry_after_s} if retry_after_s else {}
    return text("error", code=code, text=reason, **when)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """What a microphone says first."""

    sound: SoundFormat
    is_ahead: bool  # the sound may come before its time: it waits and goes on in real time
    mouth_profile: bytes  # of the speaker; empty: the average speaker


def parse_hello(message: str) -> Hello:
    """Return the first message of a microphone.

    Raises
    ------
    UserError
        Naming the field that is missing or out of range.
    """
    fields = parse_object(message)
    return Hello(
        sound=parse_sound_format(fields),
        is_ahead=bool(fields.get("ahead")),
        mouth_profile=_parse_mouth_profile(fields.get("voice", "")),
    )


def parse_sound_format(fields: dict[str, object]) -> SoundFormat:
    """Return the format of the sound that a message describes.

    Raises
    ------
    UserError
        Naming the field that is missing or out of range.
    """
    return SoundFormat(
        sample_rate_hz=fields.get("sample_rate_hz"),  # type: ignore[arg-type] # it is checked there
        num_channels=fields.get("num_channels", 1),  # type: ignore[arg-type]
        encoding=fields.get("encoding", "s16le"),  # type: ignore[arg-type]
    )


def _parse_mouth_profile(field: object) -> bytes:
    try:
        profile = base64.b64decode(field, validate=True) if isinstance(field, str) else None
    except ValueError:
        profile = None
    if profile is None or len(profile) > MAX_MOUTH_PROFILE_BYTES:
        raise UserError(f"voice must be at most {MAX_MOUTH_PROFILE_BYTES >> 10} KiB in base64")
    return profile


@dataclass(frozen=True, slots=True, kw_only=True)
class MicrophoneCommand:
    """A command between the chunks of a browser's microphone."""

    flush: bool  # interrupt: audio not yet shown is dropped
    eof: bool  # no more audio comes
    num_skipped: int  # samples of each channel that it left out
    lips: str  # the lip model that is to move the mouth; empty: as before


def parse_command(message: str) -> MicrophoneCommand:
    """Return a text message of a microphone.

    Raises
    ------
    UserError
        If it is no JSON object, the number of samples is out of range, or there is no such lip
        model.
    """
    check_text(message, "binary messages of samples, or a JSON object")
    fields = parse_object(message)
    num_skipped = fields.get("skip", 0)
    if type(num_skipped) is not int or not 0 <= num_skipped <= MAX_SKIPPED:
        raise UserError(f"skip must be a whole number of 0 to {MAX_SKIPPED}")
    return MicrophoneCommand(
        flush=bool(fields.get("flush")),
        eof=bool(fields.get("eof")),
        num_skipped=num_skipped,
        lips=parse_lips(fields),
    )


def parse_lips(fields: dict[str, object]) -> str:
    """Return the lip model that a message asks for; empty: none.

    Raises
    ------
    UserError
        If there is no such lip model.
    """
    lips = fields.get("lips", "")
    if not isinstance(lips, str) or lips not in ("", *LipModelName):
        raise UserError(f"lips must be one of {', '.join(LipModelName)}")
    return lips


@dataclass(frozen=True, slots=True, kw_only=True)
class Expressions:
    """What the face is to show beside speech."""

    strengths: dict[str, float]  # 0 to 1, by name; empty: nothing any more
    hold_s: float  # before they fade


def parse_expressions(fields: dict[str, object]) -> Expressions | None:
    """Return the expressions that a message asks for, if it does.

    Raises
    ------
    UserError
        If there is no such expression, or a number is out of range.
    """
    strengths, hold_s = fields.get("express"), fields.get("hold_s", DEFAULT_HOLD_S)
    if strengths is None:
        return None
    if not isinstance(strengths, dict):
        raise UserError("express must be an object of strengths by name")
    check_expressions(strengths, hold_s)
    return Expressions(strengths=strengths, hold_s=float(hold_s))  # type: ignore[arg-type]


def parse_expressiveness(fields: dict[str, object]) -> float | None:
    """Return how much a message wants the mouth to move, if it does.

    Raises
    ------
    UserError
        If that is out of range.
    """
    amount = fields.get("expressiveness")
    return None if amount is None else check_expressiveness(amount)


def parse_object(message: str) -> dict[str, object]:
    """Return a JSON object.

    Raises
    ------
    UserError
        If it is none.
    """
    try:
        fields = json.loads(message)
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise UserError("expected a JSON object")
    return fields
