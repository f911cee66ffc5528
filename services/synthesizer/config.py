"""The synthesizer's configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from shared.config import BoundEndpoint, ServiceConfig
from shared.face.lip_models import LipModelName


class SynthesizerConfig(ServiceConfig):
    """The synthesizer's own keys."""

    phone_input: BoundEndpoint = "tcp://127.0.0.1:5570"
    """Where the recognizer sends phones."""
    faps: BoundEndpoint = "tcp://127.0.0.1:5571"
    """Where FAP frames are published."""
    frame_rate_hz: Annotated[float, Field(ge=10, le=240)] = 50.0
    """FAP frames per second."""
    delay_ms: Annotated[float, Field(ge=0, le=300)] = 160.0
    """How much later than its sound a frame is made, in steps of 20 ms."""
    lips: LipModelName = LipModelName.DYNAMIC_VISEMES
    """Lip model: of recognised phones (dynamic-visemes), or of the sound itself (learnt)."""
    idle_motion_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 3
    """Seed of blinks, gaze and head motion; with 0 the mouth alone moves."""
