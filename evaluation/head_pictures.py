"""Draws every head: small pictures for the page, and sheets for the docs."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kouxing.services.driver.config import Framing
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.scene import place_camera
from kouxing.services.heads import DEFAULT_HEAD, HEAD_NAMES
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.services.synthesizer.modifiers.expressiveness import scale_mouth
from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.high_level_faps import EXPRESSION_NAMES, EXPRESSIONS
from kouxing.shared.files.output_file import create_folder, open_output

_YAWS_DEG, _PROFILE_DEG = (0.0, 40.0), 80.0
_HEAD_PX, _VISEME_PX, _THUMBNAIL_PX = (240, 200), (160, 160), (160, 160)
_MOUTH_PX, _FACE_PX = (176, 132), (272, 204)
_MOUTH_VISEMES = ("a", "i", "u", "o", "e", "v", "f", "b", "d", "g")
_EXPRESSIONS = ("joy", "sadness", "anger", "surprise")
_EXPRESSIVENESS = (0.5, 1.0, 1.4, 2.0)  # values of the expressiveness
_VISEMES_PER_ROW = 9
_REST = np.zeros(NUM_FAPS, np.float32)
_SCALE = 2  # pictures are drawn larger and then reduced, for smooth edges


def _head_names() -> list[str]:
    """Return the names of the package's heads, the default one first."""
    return sorted(HEAD_NAMES, key=lambda name: (name != DEFAULT_HEAD, name))


def sheet_renderers(folder: Path) -> dict[Path, Callable[[], Image.Image]]:
    """Return the functions that draw the files for the docs."""
    image = {
        "heads": _draw_heads, "faces": _draw_visemes, "mouths": _draw_mouths,
        "expressions": _draw_expressions, "expressiveness": _draw_expressiveness,
    }  # fmt: skip
    return {folder / f"{name}.webp": draw for name, draw in image.items()}


def thumbnail_renderers(folder: Path) -> dict[Path, Callable[[], Image.Image]]:
    """Return the functions that draw the files for the page, ``head-NAME.webp``."""
    return {
        folder / f"head-{name}.webp": partial(_draw, "", name, _REST, _THUMBNAIL_PX)
        for name in _head_names()
    }


def save(path: Path, image: Image.Image) -> None:
    """Write a picture. Raises ``UserError`` if it cannot be written."""
    create_folder(path.parent)
    with open_output(path) as file:
        image.save(file, "WEBP", quality=85)


def _draw_heads() -> Image.Image:
    return _arrange_in_rows(
        [_draw(name, name, _REST, _HEAD_PX, yaw_deg) for name in _head_names()]
        for yaw_deg in _YAWS_DEG
    )


def _draw_visemes() -> Image.Image:
    visemes = list(VISEME_INDEX)
    return _arrange_in_rows(
        [
            _draw(viseme, DEFAULT_HEAD, _viseme_faps(viseme), _VISEME_PX, yaw_deg)
            for viseme in visemes[start : start + _VISEMES_PER_ROW]
        ]
        for start in range(0, len(visemes), _VISEMES_PER_ROW)
        for yaw_deg in _YAWS_DEG
    )


def _draw_mouths() -> Image.Image:
    poses = {"rest": _REST} | {viseme: _viseme_faps(viseme) for viseme in _MOUTH_VISEMES}
    views = [(name, yaw_deg) for name in _head_names() for yaw_deg in _YAWS_DEG]
    views.insert(len(_YAWS_DEG), (DEFAULT_HEAD, _PROFILE_DEG))
    return _arrange_in_rows(
        [
            _draw(label, name, faps, _MOUTH_PX, yaw_deg, Framing.MOUTH)
            for label, faps in poses.items()
        ]
        for name, yaw_deg in views
    )


def _draw_expressions() -> Image.Image:
    poses = {"rest": _REST} | {
        name: EXPRESSIONS[EXPRESSION_NAMES.index(name)] for name in _EXPRESSIONS
    }
    return _arrange_in_rows(
        [_draw(label, name, faps, _FACE_PX) for label, faps in poses.items()]
        for name in _head_names()
    )


def _draw_expressiveness() -> Image.Image:
    return _arrange_in_rows(
        [
            _draw(f"{viseme} {amount:g}", DEFAULT_HEAD, _viseme_faps(viseme, amount), _FACE_PX)
            for viseme in _MOUTH_VISEMES[:6]
        ]
        for amount in _EXPRESSIVENESS
    )


def _viseme_faps(viseme: str, expressiveness: float = SynthesizerConfig().expressiveness) -> Floats:
    """Return the FAPs (68,) of a viseme's target."""
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = load_parameters().target[VISEME_INDEX[viseme]]
    scale_mouth(faps, expressiveness)
    return faps


def _draw(
    label: str,
    name: str,
    faps: Floats,
    size: tuple[int, int],
    yaw_deg: float = 0.0,
    framing: Framing = Framing.FACE,
) -> Image.Image:
    """Draw a head, with a label if it is not empty."""
    head = Head.load(name)
    view = place_camera(head, framing, yaw_deg)
    renderer = Renderer(head, _SCALE * size[0], _SCALE * size[1], camera=view)
    image = Image.fromarray(renderer.draw(faps)).resize(size, Image.Resampling.LANCZOS)
    renderer.close()
    ImageDraw.Draw(image).text((5, 2), label, fill="white", font=ImageFont.load_default(13))
    return image


def _arrange_in_rows(drawn: Iterable[list[Image.Image]]) -> Image.Image:
    rows = list(drawn)
    width, height = rows[0][0].size
    sheet = Image.new("RGB", (width * max(map(len, rows)), height * len(rows)), "#5c6e80")
    for row, images in enumerate(rows):
        for column, image in enumerate(images):
            sheet.paste(image, (width * column, height * row))
    return sheet
