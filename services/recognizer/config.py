"""The recognizer's configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from kouxing.shared.config import BoundEndpoint, DefaultBy, ServiceConfig


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
    num_stable_frames: Annotated[int, Field(ge=1, le=20)] = Field(
        default_factory=DefaultBy("acoustic", {"neural": 1, "gmm": 1}, 2)
    )
    """Frames that must agree before a phone is emitted (N of Li 2011, who uses 3)."""
    min_confidence: Annotated[float, Field(ge=0, le=1)] = Field(
        default_factory=DefaultBy("acoustic", {"neural": 0.9, "gmm": 0.9}, 0.95)
    )
    """Confidence that each of these frames must reach; 0 is the rule of Li 2011."""
