"""The virtual camera sends pictures at its rate; errors name the missing device or library."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video.virtual_camera import VirtualCamera
from kouxing.shared.errors import UserError
from tests.heads import neutral_faps


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
