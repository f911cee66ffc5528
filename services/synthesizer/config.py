"""The synthesizer's configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from kouxing.shared.config import BoundEndpoint, DefaultBy
from kouxing.shared.face.config import FaceConfig
from kouxing.shared.face.lip_models import DEFAULT_LIP_MODEL, LipModelName

# Default delay of each lip model.
DELAYS_MS: dict[str, float] = {
    LipModelName.LEARNT: 60.0,
    LipModelName.DYNAMIC_VISEMES: 160.0,
    LipModelName.FERGUSON: 160.0,
}


class SynthesizerConfig(FaceConfig):
    """The synthesizer's own keys."""

    phone_input: BoundEndpoint = "tcp://127.0.0.1:5570"
    """Where the recognizer sends phones."""
    faps: BoundEndpoint = "tcp://127.0.0.1:5571"
    """Where FAP frames are published."""
    frame_rate_hz: Annotated[float, Field(ge=10, le=240)] = 50.0
    """FAP frames per second."""
    lips: LipModelName = DEFAULT_LIP_MODEL
    """Lip model: of recognised phones (dynamic-visemes), of the sound itself (learnt), or of one
    opening (ferguson)."""
    delay_ms: Annotated[float, Field(ge=0, le=300)] = Field(
        default_factory=DefaultBy("lips", DELAYS_MS, DELAYS_MS[DEFAULT_LIP_MODEL])
    )
    """How much later than its audio a frame is made, in steps of 20 ms."""
    expressiveness: Annotated[float, Field(ge=0.5, le=2)] = 1.4
    """How large the mouth's movements are; 1 for those of the lip model. Closures stay closed."""
