"""Offers the head as a camera that other programs, such as video calls or OBS, can select."""

import importlib

import numpy as np

from kouxing.services.driver.render.renderer import Renderer
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError, install_command


class VirtualCamera:
    """Sends pictures to the system's virtual camera, through pyvirtualcam.

    Raises ``UserError`` if pyvirtualcam is not installed or the system has no virtual camera.
    """

    def __init__(self, renderer: Renderer, frame_rate_hz: float) -> None:
        try:
            library = importlib.import_module("pyvirtualcam")
        except ImportError:
            raise UserError(
                f"driver.virtual_camera needs pyvirtualcam: {install_command('kouxing[camera]')}"
            ) from None
        self._renderer = renderer
        self._interval_s = 1.0 / frame_rate_hz
        self._due_s = 0.0
        try:
            self._camera = library.Camera(*renderer.size, frame_rate_hz)
        except RuntimeError as error:
            raise UserError(
                f"driver.virtual_camera: this system has no virtual camera ({error}); on Linux run"
                " 'modprobe v4l2loopback', elsewhere start OBS's virtual camera once"
            ) from error
        self.device: str = self._camera.device

    def draw(self, faps: Floats, now_s: float) -> None:
        """Send a picture of a face (68,) if one is due."""
        if now_s >= self._due_s:
            self._due_s = max(self._due_s + self._interval_s, now_s)
            self._camera.send(np.ascontiguousarray(self._renderer.draw(faps)))

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()
