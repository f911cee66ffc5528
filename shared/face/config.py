"""Configuration keys that several services share."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.shared.settings.config import ServiceConfig


@dataclass(frozen=True, kw_only=True)
class FaceConfig(ServiceConfig):
    """The keys of services that make or show a face."""

    idle_motion: bool = True
    """Whether the face blinks and moves its gaze, brows and head."""


@dataclass(frozen=True, kw_only=True)
class LiveConfig(ServiceConfig):
    """The keys of workers of live sessions."""

    max_lag_s: Annotated[float, Meta(ge=0.1, le=3600)] = 0.2
    """Maximum lag of a live session, in seconds. If it is exceeded for 0.4 s, the recognizer skips
    audio, or the synthesizer skips frames. From three quarters of it, the recognizer uses the light
    acoustic model."""
