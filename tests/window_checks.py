"""What ``test_window`` checks, in a process of its own: GLX beside other tests' EGL breaks both."""

from __future__ import annotations

import sys
import time

import glfw
import numpy as np

from services.driver.head import Head, neutral_faps
from services.driver.render import Renderer
from services.driver.service import DriverService
from services.driver.window import Window
from shared.config import DriverConfig
from tests.system import free_port


def shown(window: Window) -> np.ndarray:
    """What is on the screen: the front buffer, top row first."""
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
    assert red > green > blue, "skin in the middle"
    glfw.set_window_size(window._window, 480, 200)
    draw_until(window, (480, 200))
    assert shown(window).shape == (200, 480, 3)
    beside = Renderer(head, 160, 120, samples=0, context=window.context)
    assert beside.draw(neutral_faps()).shape == (120, 160, 3), "a video goes on in its context"
    assert window.draw(neutral_faps()), "and the window after it"
    glfw.set_window_should_close(window._window, True)
    assert not window.draw(neutral_faps())
    window.hide()
    window.close()


def lost_stream() -> None:
    control = f"tcp://127.0.0.1:{free_port()}"  # nobody is there
    service = DriverService(DriverConfig(control=control, view="window", width_px=64, height_px=48))
    window = service._window
    assert window is not None
    try:
        service._faps = np.full(68, 100, np.float32)
        now_s = time.monotonic()
        service._frame_s = now_s
        assert service._shown(now_s + 0.5)[2] == 100
        service._followers["demo"] = type("Follower", (), {"ended": False})()
        assert 0 < service._shown(now_s + 1.2)[2] < 100
        assert glfw.get_window_title(window._window) == "kouxing (no frames come)"
        assert not service._shown(now_s + 2.0).any()
        service._frame_s = now_s + 3.0
        assert service._shown(now_s + 3.0)[2] == 100
        assert glfw.get_window_title(window._window) == "kouxing"
    finally:
        service._followers.clear()
        window.close()
        service.bus.close()


if __name__ == "__main__":
    {"size_and_close": size_and_close, "lost_stream": lost_stream}[sys.argv[1]]()
