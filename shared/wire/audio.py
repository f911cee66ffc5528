"""A session's audio, from the client to the recognizer."""

from typing import Annotated

from kouxing_client.field_types import MAX_AUDIO_BYTES, Name
from msgspec import Meta

from kouxing.shared.wire.message import ServiceMessage


class AudioChunk(ServiceMessage, frozen=True, kw_only=True):
    """PCM in the session's encoding; media_time is the time of its first sample."""

    token: Name
    pcm: Annotated[bytes, Meta(max_length=MAX_AUDIO_BYTES)] = b""  # interleaved, little-endian
    last: bool = False  # no more audio follows: finish the session
    acknowledge: bool = False  # the client reads acknowledge messages and resends lost messages
