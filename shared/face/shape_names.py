"""Names of the blendshape sets, as used by users and messages."""

from __future__ import annotations

from enum import StrEnum

MAX_SHAPES = 256  # per set


class ShapeSetName(StrEnum):
    """A set of blendshapes."""

    ARKIT = "arkit"  # ARKit's 52 blend shapes
    OCULUS = "oculus"  # Oculus' 15 visemes
    VRM = "vrm"  # VRM 1's expressions
