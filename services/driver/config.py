"""The driver's configuration."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from kouxing.shared.config import KnownNames, Switch, ValueHint
from kouxing.shared.face.config import FaceConfig
from kouxing.shared.names import NAME

HEAD_NAMES = tuple(
    sorted(path.stem for path in (Path(__file__).parent / "head" / "assets").glob("*.npz"))
)


COLORS = {
    "black": "#000000", "white": "#ffffff", "grey": "#808080", "green": "#00b140",
    "blue": "#0047bb",
}  # fmt: skip


class Framing(StrEnum):
    """The part of the head that fills the picture."""

    FACE = "face"
    HEAD = "head"
    MOUTH = "mouth"


class DriverConfig(FaceConfig):
    """The driver's configuration keys."""

    view: Literal["auto", "window", "none"] = "auto"
    """Whether to open a window. auto opens one if a display is available."""
    session: Annotated[
        str,
        Field(pattern=f"^{NAME}$"),
        ValueHint("newest, or the name of a session (up to 64 letters, digits, '-' and '_')"),
    ] = "newest"
    """Session to show. "newest" shows the session that was opened last."""
    out: str = "out"
    """Folder for recorded videos."""
    max_videos: Annotated[int, Field(ge=1, le=1000)] = 8
    """Maximum number of videos that are written at the same time. One key can use at most three
    quarters."""
    head: Annotated[
        str,
        KnownNames(lambda: HEAD_NAMES, r".*\.\w+", ", or a file (.glb, .gltf, .vrm or .npz)"),
    ] = "woman"
    """Built-in head, or an avatar."""
    background: Annotated[
        str, KnownNames(lambda: ("studio", *COLORS), "#?[0-9a-fA-F]{6}", ", or #rrggbb")
    ] = "studio"
    """Background of windows and videos."""
    camera: Framing = Framing.FACE
    """The part of the head that fills the picture."""
    virtual_camera: Switch = False
    """Whether to offer the picture to other programs as a camera."""
    width_px: Annotated[int, Field(ge=16, le=7680, multiple_of=2)] = 1280
    """Width of the window and of videos. H.264 requires an even number."""
    height_px: Annotated[int, Field(ge=16, le=4320, multiple_of=2)] = 720
    """Height of the window and of videos. H.264 requires an even number."""
    frame_rate_hz: Annotated[float, Field(ge=10, le=240)] = 25.0
    """Images per second."""
