"""The driver's configuration."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from kouxing.shared.config import Form, Switch
from kouxing.shared.face.config import FaceConfig

HEAD_NAMES = tuple(
    sorted(path.stem for path in (Path(__file__).parent / "head" / "assets").glob("*.npz"))
)


class Framing(StrEnum):
    """The part of the head that fills the picture."""

    FACE = "face"
    HEAD = "head"
    MOUTH = "mouth"


class DriverConfig(FaceConfig):
    """The driver's configuration keys."""

    view: Literal["auto", "window", "none"] = "auto"
    """Whether to open a window; with auto, if there is a display."""
    session: Annotated[
        str,
        Field(pattern="^[A-Za-z0-9_-]{1,64}$"),
        Form("newest, or the name of a session (up to 64 letters, digits, '-' and '_')"),
    ] = "newest"
    """The session to show; "newest" is the one that opened last."""
    out: str = "out"
    """Folder for recorded videos."""
    head: str = "woman"
    """Name of a built-in head, an imported .npz, or a .glb with morph targets."""
    background: str = "studio"
    """studio, #rrggbb, or the name of a color."""
    camera: Framing = Framing.FACE
    """The part of the head that fills the picture."""
    virtual_camera: Switch = False
    """Whether other programs can use the picture as a camera."""
    width_px: Annotated[int, Field(ge=16, le=7680, multiple_of=2)] = 1280
    """Width of window and video; even because of H.264."""
    height_px: Annotated[int, Field(ge=16, le=4320, multiple_of=2)] = 720
    """Height of window and video; even because of H.264."""
    frame_rate_hz: Annotated[float, Field(ge=10, le=240)] = 25.0
    """Images per second."""
