"""The recognizer's configuration."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from kouxing.shared.config import BoundEndpoint, ServiceConfig

# Settings that suit an acoustic model and differ from the defaults below. Who chooses the model
# has them, unless others are given.
_SUITED: dict[str, dict[str, Any]] = {
    name: {"num_stable_frames": 1, "min_confidence": 0.9} for name in ("neural", "gmm")
}


class RecognizerConfig(ServiceConfig):
    """The recognizer's own keys."""

    audio: BoundEndpoint = "tcp://127.0.0.1:5560"
    """Where clients send audio of live sessions."""
    phones: BoundEndpoint = "tcp://127.0.0.1:5561"
    """Where phones and sound are published."""
    unpaced_audio: BoundEndpoint = "tcp://127.0.0.1:5562"
    """Where clients send audio of sessions that are not paced, which waits for live audio."""
    acoustic: str = "blocks"
    """Acoustic model: blocks (fewest errors), neural (half the processor time), gmm, or a file."""
    look_ahead_ms: Annotated[float, Field(ge=0, le=300)] = 10.0
    """Future audio that the neural model, which runs beside blocks too, waits for, ms: 10, 30, 60,
    100, 200."""
    num_stable_frames: Annotated[int, Field(ge=1, le=20)] = 2
    """Frames that must agree before a phone is emitted (N of Li 2011, who has 3); 1 with neural
    and gmm, unless another value is given."""
    min_confidence: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Confidence that each of those frames must reach; 0 is the rule of Li 2011; 0.9 with neural
    and gmm, unless another value is given."""

    @model_validator(mode="before")
    @classmethod
    def _suited(cls, values: dict[str, object]) -> dict[str, object]:
        """Take the settings that suit the acoustic model, where none are given."""
        return {**_SUITED.get(str(values.get("acoustic")), {}), **values}
