"""Sheets of faces: visemes and expressions on every head, and how expressiveness changes mouths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from kouxing.evaluation.system.head_pictures import head_names
from kouxing.services.driver.config import Framing
from kouxing.services.driver.head.head import DEFAULT_HEAD, Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.scene import camera
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.services.synthesizer.modifiers.expression import EXPRESSION_FAPS, mix
from kouxing.services.synthesizer.modifiers.expressiveness import Expressiveness
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

_VISEMES = {
    "rest": "rest", "a": "a", "i": "i", "u": "u", "o": "o", "e": "e", "v": "yu", "f": "f",
    "b": "b", "d": "d", "g": "g",
}  # fmt: skip
_VOWELS = ("a", "i", "u", "o", "e", "v")
_EXPRESSIONS = ("joy", "sadness", "anger", "surprise")
_AMOUNTS = (0.5, 1.0, SynthesizerConfig().expressiveness, 2.0)
_CELL_PX = (176, 132)
_FACE_PX = (272, 204)
_LABEL_PX = 13
_SCALE = 2  # drawn so much larger, for smooth edges
_PROFILE_DEG, _THREE_QUARTER_DEG = 90.0, 40.0


def draw_mouth_sheets(folder: Path) -> list[Path]:
    """Write mouths, expressiveness and expressions (.webp) into a folder; return their paths.

    Raises
    ------
    UserError
        If they cannot be written.
    """
    usual = SynthesizerConfig().expressiveness
    rows, faces = [], []
    for name in head_names():
        turns = [0.0, _THREE_QUARTER_DEG] + [_PROFILE_DEG] * (name == DEFAULT_HEAD)
        shapes = {label: _expressed(viseme, usual) for viseme, label in _VISEMES.items()}
        rows += [_row(name, shapes, Framing.MOUTH, turn, _CELL_PX) for turn in turns]
        shapes = {each or "rest": _shown(each) for each in ("", *_EXPRESSIONS)}
        faces.append(_row(name, shapes, Framing.FACE, 0.0, _FACE_PX))
    levels = []
    for amount in _AMOUNTS:
        shapes = {f"{_VISEMES[each]}  {amount:g}": _expressed(each, amount) for each in _VOWELS}
        levels.append(_row(DEFAULT_HEAD, shapes, Framing.FACE, 0.0, _FACE_PX))
    return [
        _save(folder / "mouths.webp", rows),
        _save(folder / "expressiveness.webp", levels),
        _save(folder / "expressions.webp", faces),
    ]


def _expressed(viseme: str, amount: float) -> Float32:
    """FAPs (68,) of a viseme's static targets."""
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = load_parameters().target[VISEME_INDEX[viseme]]
    Expressiveness(amount).scale(faps)
    return faps


def _shown(expression: str) -> Float32:
    """FAPs (68,) of a face at rest that shows an expression; "": none."""
    faps = np.zeros(NUM_FAPS, np.float32)
    if expression:
        mix(faps, EXPRESSION_FAPS[expression], free=1.0)
    return faps


def _row(
    name: str, shapes: dict[str, Float32], framing: Framing, yaw_deg: float, size: tuple[int, int]
) -> UInt8:
    head = Head.load(name)
    drawn_size = (_SCALE * size[0], _SCALE * size[1])
    renderer = Renderer(head, *drawn_size, camera=camera(head, framing, yaw_deg))
    cells = []
    for label, faps in shapes.items():
        cell = Image.fromarray(renderer.draw(faps)).resize(size, Image.Resampling.LANCZOS)
        font = ImageFont.load_default(_LABEL_PX)
        ImageDraw.Draw(cell).text((5, 2), label, fill="white", font=font)
        cells.append(np.asarray(cell))
    renderer.close()
    return np.concatenate(cells, axis=1)


def _save(path: Path, rows: Sequence[UInt8]) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.concatenate(rows)).save(path, quality=85)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
    return path
