"""A session's audio: from the client to the recognizer, and from there to all subscribers."""

from typing import Annotated, ClassVar

from msgspec import Meta

from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message, Name


class AudioChunk(Message, frozen=True, kw_only=True):
    """PCM in the session's encoding; media_time is the time of its first sample."""

    token: Name
    pcm: Annotated[bytes, Meta(max_length=MAX_AUDIO_BYTES)] = b""  # interleaved, little-endian
    last: bool = False  # no more audio follows: finish the session
    acknowledge: bool = False  # the client reads acknowledge messages and resends lost messages


class Sound(Message, frozen=True, kw_only=True):
    """The session's audio as the recognizer reads it: 16 kHz mono."""

    published_at: ClassVar[str | None] = "phones"

    pcm: Annotated[bytes, Meta(max_length=4 * MAX_AUDIO_BYTES)]  # int16, little-endian
