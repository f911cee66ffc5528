"""Rendering without a display: framings, backgrounds, windows, the virtual camera and errors."""

import sys
from types import SimpleNamespace
from typing import Any

import moderngl
import numpy as np
import pytest

from kouxing.services.driver.config import DriverConfig, Framing
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render import renderer as render
from kouxing.services.driver.render.renderer import BACKGROUND, Renderer
from kouxing.services.driver.render.scene import load_head, parse_background, place_camera
from kouxing.services.driver.render.window import Window
from kouxing.services.driver.video.virtual_camera import VirtualCamera
from kouxing.services.driver.view import View
from kouxing.shared.errors import UserError
from tests.heads import neutral_faps


@pytest.fixture(scope="module")
def head() -> Head:
    return Head.load(detail="coarse")


def test_error_names_missing_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(**_: Any) -> None:
        raise Exception("libEGL.so not loaded")

    monkeypatch.setattr(moderngl, "create_standalone_context", fail)
    with pytest.raises(UserError, match="libegl1 libgl1 libgl1-mesa-dri"):
        render.create_offscreen_context()


def test_a_window_needs_a_display(head: Head, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UserError, match="display"):
        Window(head, 160, 120)


def seen(head: Head, framing: Framing, point: str, size: tuple[int, int] = (160, 90)) -> np.ndarray:
    """Return the position of a feature point in the picture, -1 to 1."""
    matrix = place_camera(head, framing).view_projection(*size)
    place = matrix @ [*head.vertices[head.feature_points[point]], 1.0]
    seen_at: np.ndarray = place[:2] / place[3]
    return seen_at


@pytest.mark.parametrize("framing", list(Framing))
def test_framed_parts_are_in_the_picture(head: Head, framing: Framing) -> None:
    points = {
        "face": ("2.1", "11.1", "10.1"),
        "head": ("11.4",),
        "side": ("11.4", "9.3"),
        "mouth": ("9.3", "2.1", "8.3"),
    }
    for point in points[framing]:
        assert np.abs(seen(head, framing, point)).max() < 0.97


def test_parses_backgrounds_and_rejects_others() -> None:
    assert parse_background("studio") == BACKGROUND
    assert parse_background("transparent") is None
    assert parse_background("#Ff8000") == ((1.0, 128 / 255, 0.0),) * 2
    assert parse_background("white") == ((1.0, 1.0, 1.0),) * 2
    assert parse_background("gray") == parse_background("Grey") == ((128 / 255,) * 3,) * 2
    for text in ("", "pink-ish", "#12345", "#gggggg"):
        with pytest.raises(UserError, match="write studio, transparent, #rrggbb"):
            parse_background(text)


@pytest.mark.parametrize(
    ("name", "message"),
    [("nobody", "unknown head"), ("my.obj", "head import"), ("my.glb", "my.glb")],
)
def test_error_of_an_unknown_head(name: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_head(name)


def test_a_driver_without_an_output_reports_a_missing_head() -> None:
    with pytest.raises(UserError, match=r"my\.glb"):
        View(DriverConfig(view="none", head="my.glb"), lambda _: None)


class Device:
    """Replaces the library's camera."""

    device = "/dev/video0"

    def __init__(self, width: int, height: int, fps: float) -> None:
        self.shape = (height, width, 3)
        self.sent: list[np.ndarray] = []

    def send(self, image: np.ndarray) -> None:
        assert image.shape == self.shape
        assert image.dtype == np.uint8
        assert image.flags.c_contiguous
        self.sent.append(image)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(Head.load(detail="coarse"), 64, 48, samples=0)


def test_sends_pictures_at_the_frame_rate(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=Device))
    camera = VirtualCamera(renderer, 25.0)
    for tick in range(101):
        camera.draw(neutral_faps(), 100 + tick * 0.01)
    assert 25 <= len(camera._camera.sent) <= 26


def test_errors_name_missing_requirements(
    renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    with pytest.raises(UserError, match=r"kouxing\[camera\]"):
        VirtualCamera(renderer, 25.0)

    def no_device(*_: Any) -> None:
        raise RuntimeError("no v4l2 loopback device found")

    monkeypatch.setitem(sys.modules, "pyvirtualcam", SimpleNamespace(Camera=no_device))
    with pytest.raises(UserError, match="modprobe v4l2loopback"):
        VirtualCamera(renderer, 25.0)
