"""Configuration that all services with a face share."""

from typing import Annotated

from pydantic import Field

from kouxing.shared.config import ServiceConfig


class FaceConfig(ServiceConfig):
    """The keys of services that make or show a face."""

    idle_motion_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 3
    """Random seed of the idle motion: blinks, gaze, brows and head motion. 0 turns it off."""
