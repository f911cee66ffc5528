"""Messages of a client and control about a session, and the confirmation of subscriptions."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from msgspec import Meta

from kouxing.shared.face.expressions import DEFAULT_HOLD_S
from kouxing.shared.wire.message import (
    ChosenLips,
    Count,
    Encoding,
    Endpoint,
    ExpressionMap,
    ExpressivenessAmount,
    FrameRate,
    HoldTime,
    LanguageName,
    Message,
    MouthProfile,
    Name,
    NameOrNone,
    NumChannels,
    SampleRate,
    ShapeNameMap,
    ShapeSets,
    Text,
)


class ErrorCode(StrEnum):
    """The codes of ``error`` messages."""

    BAD_MESSAGE = "bad-message"
    BAD_AUDIO = "bad-audio"
    BAD_TOKEN = "bad-token"  # noqa: S105 - no password
    BAD_VOICE = "bad-voice"
    BUSY = "busy"
    FINISHED = "finished"
    NO_SERVICE = "no-service"
    NO_VIDEO = "no-video"
    NOT_ALLOWED = "not-allowed"
    SESSION_EXISTS = "session-exists"
    TIMEOUT = "timeout"
    TOO_MANY_SERVICES = "too-many-services"
    TOO_MANY_SESSIONS = "too-many-sessions"
    UNKNOWN_SESSION = "unknown-session"


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenSession(Message):
    """A client asks for a session; an empty session name lets control choose one."""

    request: Name  # echoed in the answer; a repeated request gets the same answer
    encoding: Encoding = "s16le"
    sample_rate_hz: SampleRate = 16000
    num_channels: NumChannels = 1
    record: bool = False  # the driver writes a video named after the session
    paced: bool = True  # audio comes in real time; false: as fast as the services take it
    voice: MouthProfile = b""  # of the speaker, for the lip model
    shapes: ShapeSets = field(default_factory=list)  # sets that are published beside FAP frames


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionOpened(Message):
    """The session exists; these are the sockets to use."""

    request: Name
    token: Name  # proves ownership when the client sends audio, flushes or closes
    audio: Endpoint  # ROUTER for the client's audio
    phones: Endpoint  # XPUB: phone, speech, sound
    faps: Endpoint  # XPUB: fap-frame, shapes, end-of-faps
    events: Endpoint  # XPUB: event, session-moved
    language: LanguageName = ""  # of the phones
    frame_rate_hz: FrameRate = 0.0  # of the FAP frames
    shapes: ShapeNameMap = field(default_factory=dict)  # names in each set that is published


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionMoved(Message):
    """Another process serves a part of the session from here on; ``epoch`` is the new one.

    Sent to the client, and published for whoever follows the session.
    """

    audio: Endpoint
    phones: Endpoint
    faps: Endpoint
    next_sequence: Count  # first audio message to send to `audio`; 0: audio goes on as before


@dataclass(frozen=True, slots=True, kw_only=True)
class CloseSession(Message):
    """The client is done; the services forget the session."""

    request: Name
    token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class FlushSession(Message):
    """Interrupts: audio not yet shown is dropped and the face returns to rest."""

    request: Name
    token: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class ChooseLips(Message):
    """Lets another lip model move the mouth, while the session goes on."""

    request: Name
    token: Name
    lips: ChosenLips


@dataclass(frozen=True, slots=True, kw_only=True)
class Express(Message):
    """Lets the face show expressions for a while; control passes it on to the services."""

    request: Name
    expressions: ExpressionMap  # strengths by name, in place of those before; empty: they fade now
    hold_s: HoldTime = DEFAULT_HOLD_S  # that they stay before they fade


@dataclass(frozen=True, slots=True, kw_only=True)
class ChooseExpressiveness(Message):
    """Makes the mouth move more or less; control passes it on to the services."""

    request: Name
    expressiveness: ExpressivenessAmount  # 1: as the lip model moves it


@dataclass(frozen=True, slots=True, kw_only=True)
class AddShapes(Message):
    """Lets a session publish more sets of shapes; control tells the services all of them."""

    request: Name
    shapes: ShapeSets


@dataclass(frozen=True, slots=True, kw_only=True)
class Done(Message):
    """A request was carried out.

    For a ``start-session``, ``media_time`` says up to where the session's phones are final at this
    service; 0 where it keeps none.
    """

    request: Name


@dataclass(frozen=True, slots=True, kw_only=True)
class Error(Message):
    """A request or message was refused, or something failed.

    Every version of the protocol keeps its kind and fields, and a message of another version is
    answered in that version, so that every client can read why it was refused.
    """

    code: Name  # an ErrorCode, or one of a later build
    text: Text
    request: NameOrNone = ""
    retry_after_s: Annotated[float, Meta(ge=0, le=3600)] = 0.0  # 0: not stated


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined(Message):
    """Answers a subscription to ``joined/<session>/``: that peer's earlier ones are in effect."""

    publisher: Name  # differs between publishers; wait for as many as you connected to
