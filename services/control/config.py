"""Control's configuration."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from shared.config import BoundEndpoint, ServiceConfig


class ControlConfig(ServiceConfig):
    """Control's own keys."""

    commands: BoundEndpoint = "tcp://127.0.0.1:5550"
    """Where control takes commands."""
    events: BoundEndpoint = "tcp://127.0.0.1:5551"
    """Where control publishes events."""
    max_sessions: Annotated[int, Field(ge=1, le=2000)] = 64
    """Sessions that may be open at once; of one key, three quarters of them."""
    idle_limit_s: Annotated[float, Field(ge=1, le=86400)] = 60.0
    """Seconds without audio after which a session is closed."""
    lost_after_s: Annotated[float, Field(ge=1, le=3600)] = 3.0
    """Seconds without heartbeat after which a service counts as lost."""
