"""The sets of shapes, by what users and messages call them."""

from __future__ import annotations

from enum import StrEnum

MAX_SHAPES = 256  # of a set


class ShapeSetName(StrEnum):
    """Whose shapes they are."""

    ARKIT = "arkit"  # ARKit's 52 blend shapes
    OCULUS = "oculus"  # Oculus' 15 visemes
    VRM = "vrm"  # VRM 1's expressions
