"""The driver's configuration."""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from msgspec import Meta

from kouxing.services.heads import HeadConfig
from kouxing.shared.name_rules import NAME
from kouxing.shared.settings.config import Check, KnownNames, ValueHint

COLORS = {
    "black": "#000000", "white": "#ffffff", "gray": "#808080", "green": "#00b140",
    "blue": "#0047bb",
}  # fmt: skip


class Framing(StrEnum):
    """View of the head."""

    FACE = "face"
    HEAD = "head"
    MOUTH = "mouth"
    SIDE = "side"  # the head at 60 degrees


def parse_size(text: str) -> tuple[int, int]:
    """Return width and height of ``WIDTHxHEIGHT``, pixels; raises ``ValueError`` for other texts.

    Limits are 16x16 and 7680x4320.
    """
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text, re.ASCII)
    if match is None:
        raise ValueError("write WIDTHxHEIGHT, for example 1280x720")
    width_px, height_px = int(match[1]), int(match[2])
    if not (16 <= width_px <= 7680 and 16 <= height_px <= 4320):
        raise ValueError("choose a size from 16x16 to 7680x4320")
    return width_px, height_px


def check_even(size_px: tuple[int, int]) -> None:
    """Raise ``ValueError`` for a size that H.264 does not allow."""
    if any(number % 2 for number in size_px):
        raise ValueError("both numbers must be even for a video")


def _check_size(text: str) -> str:
    check_even(parse_size(text))
    return text


@dataclass(frozen=True, kw_only=True)
class DriverConfig(HeadConfig):
    """The driver's configuration keys."""

    view: Literal["auto", "window", "none"] = "auto"
    """Whether to open a window. auto opens one if a display is available."""
    session: Annotated[
        str,
        Meta(pattern=rf"^{NAME}\Z"),
        ValueHint("newest, or the name of a session (up to 64 letters, digits, '-' and '_')"),
    ] = "newest"
    """Session to show. "newest" shows the session that was opened last."""
    out: str = "out"
    """Folder for recorded videos."""
    max_videos: Annotated[int, Meta(ge=1, le=1000)] = 8
    """Maximum number of videos that are written at the same time. One key can use at most three
    quarters."""
    background: Annotated[
        str, KnownNames(lambda: ("studio", *COLORS), "#?[0-9a-fA-F]{6}|(?i:grey)", ", or #rrggbb")
    ] = "studio"
    """Background of windows and videos."""
    camera: Framing = Framing.FACE
    """What fills the picture: the face, the head or the mouth. side shows the head at 60
    degrees."""
    virtual_camera: bool = False
    """Whether to offer the picture to other programs as a camera."""
    size: Annotated[
        str, Check(_check_size), ValueHint("an even WIDTHxHEIGHT from 16x16 to 7680x4320")
    ] = "1280x720"
    """Size of the window and of videos, in pixels."""
    frame_rate_hz: Annotated[float, Meta(ge=10, le=240)] = 25.0
    """Frames per second in videos and of the virtual camera. A window uses the display's refresh
    rate."""

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the window and of videos."""
        return parse_size(self.size)
