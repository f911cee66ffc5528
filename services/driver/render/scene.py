"""Chooses the head, camera and background of a picture."""

import re
from pathlib import Path

import moderngl
import numpy as np

from kouxing.services.driver.config import COLORS, DriverConfig, Framing
from kouxing.services.driver.head.glb_head import read_glb
from kouxing.services.driver.head.head import Detail, Head
from kouxing.services.driver.render.renderer import BACKGROUND, Background, Camera, Renderer
from kouxing.services.heads import DEFAULT_HEAD
from kouxing.shared.errors import UserError

# height of the picture's center above the eyes, and distance of the camera, in FAPU ES
_FRAMINGS = {
    Framing.FACE: (-0.267, 20.0), Framing.HEAD: (-0.25, 26.0), Framing.MOUTH: (-1.20, 6.6),
    Framing.SIDE: (-0.25, 26.0),
}  # fmt: skip
_SIDE_DEG = 60.0
_RISE = 0.0114  # height of the camera above the center, as a fraction of its distance


def load_head(name: str = DEFAULT_HEAD, detail: Detail = "fine") -> Head:
    """Read a built-in head, an ``.npz``, or a GLB or VRM with shapes.

    Raises ``UserError`` if the head does not exist, or the file is not a head.
    """
    path = Path(name)
    if path.suffix.lower() in (".glb", ".gltf", ".vrm"):
        return read_glb(path)
    if path.suffix.lower() in (".obj", ".stl", ".ply", ".fbx", ".wrl"):
        raise UserError(
            f"{path}: export an avatar as .glb or .vrm. For a mesh without shapes, see"
            " kouxing head import --help"
        )
    return Head.load(path, detail)


def place_camera(
    head: Head, framing: Framing = Framing.FACE, yaw_deg: float | None = None
) -> Camera:
    """Place the camera at an angle to the subject's left; by default the angle of ``framing``."""
    eyes = head.eye_centers.mean(axis=0)
    unit_m = float(head.eye_centers[0, 0] - head.eye_centers[1, 0])
    height, distance = _FRAMINGS[framing]
    target = np.array([eyes[0], eyes[1] + height * unit_m, 0.0])
    if yaw_deg is None:
        yaw_deg = _SIDE_DEG if framing is Framing.SIDE else 0.0
    yaw, pitch = np.radians(yaw_deg), np.arctan(_RISE)
    if framing is Framing.MOUTH:  # from close up, aim at the face instead of the head's pivot
        target[2] = eyes[2]
    ahead = [np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)]
    position = target + (distance * unit_m) * np.array(ahead)
    return Camera(position=tuple(position.tolist()), target=tuple(target.tolist()))


def parse_background(text: str) -> Background:
    """Parse a background: studio, transparent, the name of a color, or ``#rrggbb``.

    Raises ``UserError`` if the text is not a background.
    """
    word = text.strip().lower()
    if word == "studio":
        return BACKGROUND
    if word == "transparent":
        return None
    code = COLORS.get("gray" if word == "grey" else word, word).removeprefix("#")
    if not re.fullmatch(r"[0-9a-f]{6}", code):
        raise UserError(
            f"unknown background {text!r}; write studio, transparent, #rrggbb, or one of"
            f" {', '.join(COLORS)}"
        )
    color = tuple(int(code[i : i + 2], 16) / 255 for i in (0, 2, 4))
    return color, color


def open_renderer(config: DriverConfig, context: moderngl.Context | None = None) -> Renderer:
    """Open a renderer for the driver's videos. ``context`` is the OpenGL context of a window.

    Raises ``UserError`` if OpenGL cannot start, or a setting is invalid.
    """
    head = load_head(config.head)
    return Renderer(
        head,
        *config.size_px,
        background=parse_background(config.background),
        camera=place_camera(head, config.camera),
        context=context,
    )
