"""Checks for ``test_window``, run in a separate process because GLX and EGL conflict."""

import time
from typing import Any

import glfw
import numpy as np

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.window import Window
from tests.heads import neutral_faps


def shown(window: Window) -> np.ndarray:
    """Return the front buffer, top row first."""
    screen = window.context.screen
    width, height = glfw.get_framebuffer_size(window._window)
    raw = screen.read(viewport=(0, 0, width, height), components=3, alignment=1)
    return np.frombuffer(raw, np.uint8).reshape(height, width, 3)[::-1]


def draw_until(window: Window, size: tuple[int, int]) -> None:
    for _ in range(1000):
        assert window.draw(neutral_faps())
        if window._renderer.size == size:
            return
        time.sleep(0.02)
    raise AssertionError(f"the window stayed at {window._renderer.size}")


def size_and_close() -> None:
    head = Head.load(detail="coarse")
    window = Window(head, 320, 240, background=((1.0, 1.0, 1.0),) * 2)
    draw_until(window, (320, 240))
    image = shown(window)
    assert image[5, 5].tolist() == [255, 255, 255]
    red, green, blue = image[124, 160].astype(int)
    assert red > green > blue
    glfw.set_window_size(window._window, 480, 200)
    draw_until(window, (480, 200))
    assert shown(window).shape == (200, 480, 3)
    beside = Renderer(head, 160, 120, samples=0, context=window.context)
    assert beside.draw(neutral_faps()).shape == (120, 160, 3)
    assert window.draw(neutral_faps())
    glfw.set_window_should_close(window._window, True)
    assert not window.draw(neutral_faps())
    window.hide()
    window.close()


def switch() -> None:
    steps: list[int] = []
    window = Window(Head.load(detail="coarse"), 64, 48, on_switch=steps.append)
    library: Any = glfw  # its types do not say that setting a handler returns the one before
    on_key = library.set_key_callback(window._window, None)
    on_button = library.set_mouse_button_callback(window._window, None)
    for key, modifiers in (
        (glfw.KEY_TAB, 0),
        (glfw.KEY_RIGHT, 0),
        (glfw.KEY_TAB, glfw.MOD_SHIFT),
        (glfw.KEY_LEFT, 0),
        (glfw.KEY_A, 0),
    ):
        for action in (glfw.PRESS, glfw.RELEASE):
            on_key(window._window, key, 0, action, modifiers)
    for action in (glfw.PRESS, glfw.RELEASE):
        on_button(window._window, glfw.MOUSE_BUTTON_LEFT, action, 0)
    assert steps == [1, 1, -1, -1, 1]
    window.close()


if __name__ == "__main__":
    size_and_close()
    switch()
