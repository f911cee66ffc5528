"""A session's audio: what its client sends, and what the recognizer makes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message, Name


@dataclass(frozen=True, slots=True, kw_only=True)
class AudioChunk(Message):
    """PCM in the session's encoding; media_time is that of its first sample."""

    token: Name
    pcm: Annotated[bytes, Meta(max_length=MAX_AUDIO_BYTES)]  # interleaved, little-endian
    acknowledge: bool = False  # the client reads acknowledgements, and sends again what is lost


@dataclass(frozen=True, slots=True, kw_only=True)
class EndOfAudio(Message):
    """No more audio will come; the services finish the session."""

    token: Name
    acknowledge: bool = False  # as in AudioChunk


@dataclass(frozen=True, slots=True, kw_only=True)
class Sound(Message):
    """The session's audio as the recognizer reads it: 16 kHz mono."""

    pcm: Annotated[bytes, Meta(max_length=4 * MAX_AUDIO_BYTES)]  # int16, little-endian
