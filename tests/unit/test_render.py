"""Rendering without a display."""

from __future__ import annotations

from typing import Any

import moderngl
import numpy as np
import pytest

from kouxing.services.driver.head.head import Head, neutral_faps
from kouxing.services.driver.render import renderer as render
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.window import Window
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def head() -> Head:
    return Head.load(detail="coarse")


def test_drawing_into_a_window(head: Head, monkeypatch: pytest.MonkeyPatch) -> None:
    context = render.standalone_context()
    screen = context.simple_framebuffer((160, 120), components=3)  # replaces the window
    monkeypatch.setattr(moderngl.Context, "screen", property(lambda _: screen))
    renderer = Renderer(head, 160, 120, context=context, on_screen=True)
    renderer.draw_on_screen(neutral_faps())
    shown = np.frombuffer(screen.read(components=3), np.uint8).reshape(120, 160, 3)[::-1]
    other = Renderer(head, 160, 120, samples=0)
    np.testing.assert_allclose(shown.astype(int), other.draw(neutral_faps()).astype(int), atol=2)
    other.close()
    renderer.close()
    context.release()


def test_rejects_an_empty_picture(head: Head) -> None:
    with pytest.raises(UserError, match="positive size"):
        Renderer(head, 0, 60)


def test_error_names_missing_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: Any) -> None:
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_standalone_context", fail)
    with pytest.raises(UserError, match="libegl1 libgl1 libgl1-mesa-dri"):
        render.standalone_context()


def test_a_window_needs_a_display(head: Head, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UserError, match="display"):
        Window(head, 160, 120)
