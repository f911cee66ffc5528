"""The recognizer's configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from shared.config import BoundEndpoint, ServiceConfig


class RecognizerConfig(ServiceConfig):
    """The recognizer's own keys."""

    audio: BoundEndpoint = "tcp://127.0.0.1:5560"
    """Where clients send audio."""
    phones: BoundEndpoint = "tcp://127.0.0.1:5561"
    """Where phones and sound are published."""
    acoustic: str = "neural"
    """Acoustic model: neural, window, gmm, or a model file."""
    look_ahead_ms: Annotated[float, Field(ge=0, le=300)] = 10.0
    """Future audio that a frame waits for, ms: neural 10, 30, 60, 100, 200; window 0, 10, 20..."""
    num_stable_frames: Annotated[int, Field(ge=1, le=20)] = 1
    """Frames that must agree before a phone is emitted (N of Li 2011, who has 3)."""
    min_confidence: Annotated[float, Field(ge=0, le=1)] = 0.9
    """Confidence that each of those frames must reach; 0 is the rule of Li 2011."""
