"""Checks for ``test_window``, run in a separate process because GLX and EGL conflict."""

from __future__ import annotations

import ctypes
import ctypes.util
import sys
import time

import glfw
import numpy as np

from kouxing.services.driver.head.head import Head, neutral_faps
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.window import Window


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
    draw_until(window, (64, 48))
    xlib = ctypes.CDLL(ctypes.util.find_library("X11"))
    for key, modifiers in (("Tab", 0), ("Right", 0), ("Tab", SHIFT_MASK), ("Left", 0), ("a", 0)):
        send_event(xlib, window, KEY_PRESS, key_code(xlib, key), modifiers)
    send_event(xlib, window, BUTTON_PRESS, 1, 0)
    for _ in range(1000):
        assert window.draw(neutral_faps())
        if len(steps) == 5:
            break
        time.sleep(0.02)
    assert steps == [1, 1, -1, -1, 1]
    window.close()


KEY_PRESS, BUTTON_PRESS = 2, 4  # types of events, X.h
SHIFT_MASK = 1


class InputEvent(ctypes.Structure):
    """An XKeyEvent; an XButtonEvent has the same layout."""

    _fields_ = (
        ("type", ctypes.c_int),
        ("serial", ctypes.c_ulong),
        ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p),
        ("window", ctypes.c_ulong),
        ("root", ctypes.c_ulong),
        ("subwindow", ctypes.c_ulong),
        ("time", ctypes.c_ulong),
        ("place", ctypes.c_int * 4),
        ("modifiers", ctypes.c_uint),
        ("detail", ctypes.c_uint),
        ("same_screen", ctypes.c_int),
        ("rest_of_xevent", ctypes.c_long * 24),
    )


def key_code(xlib: ctypes.CDLL, name: str) -> int:
    xlib.XStringToKeysym.restype = ctypes.c_ulong
    symbol = ctypes.c_ulong(xlib.XStringToKeysym(name.encode()))
    code: int = xlib.XKeysymToKeycode(display(), symbol)
    return code


def send_event(xlib: ctypes.CDLL, window: Window, kind: int, detail: int, modifiers: int) -> None:
    """Send a key or a mouse button to the window, as the X server does."""
    target = glfw.get_x11_window(window._window)
    event = InputEvent(
        type=kind,
        display=display(),
        window=target,
        modifiers=modifiers,
        detail=detail,
        same_screen=1,
    )
    xlib.XSendEvent(display(), ctypes.c_ulong(target), 1, ctypes.c_long(0), ctypes.byref(event))
    xlib.XFlush(display())


def display() -> ctypes.c_void_p:
    return ctypes.c_void_p(glfw.get_x11_display())  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    {"size_and_close": size_and_close, "switch": switch}[sys.argv[1]]()
