"""Shows a face live in a window, a virtual camera, both or neither.

The imports for drawing are slow, so they are inside functions. A driver without an output then
starts twice as fast and needs half the memory.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TYPE_CHECKING

from kouxing.services.driver.config import DriverConfig
from kouxing.services.heads import HEAD_NAMES
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG

if TYPE_CHECKING:
    from kouxing.services.driver.render.window import Window
    from kouxing.services.driver.video.virtual_camera import VirtualCamera


class View:
    """Opens the configured outputs and draws a face there.

    ``on_switch`` is called with 1 or -1 when the user switches to the next or previous session.

    Raises ``UserError`` if the head or background is unknown, or a required output is not
    available.
    """

    def __init__(self, config: DriverConfig, on_switch: Callable[[int], None]) -> None:
        self._window = _open_window(config, on_switch)
        self._is_window_open = self._window is not None
        self._virtual_camera: VirtualCamera | None = None
        if config.virtual_camera:
            from kouxing.services.driver.render.scene import open_renderer
            from kouxing.services.driver.video.virtual_camera import VirtualCamera

            renderer = open_renderer(config, self._window.context if self._window else None)
            self._virtual_camera = VirtualCamera(renderer, config.frame_rate_hz)
            LOG.info("the virtual camera is %s", self._virtual_camera.device)
        elif self._window is None and config.head not in HEAD_NAMES:
            from kouxing.services.driver.render.scene import load_head

            load_head(config.head)  # a wrong file is an error even without an output

    @property
    def is_live(self) -> bool:
        """Whether a window or a virtual camera shows the face."""
        return self._is_window_open or self._virtual_camera is not None

    def show(self, faps: Floats, caption: str, now_s: float) -> None:
        """Draw a face (68,) and set the window's caption."""
        if self._window is not None and self._is_window_open:
            self._window.set_caption(caption)
            self._is_window_open = self._window.draw(faps)
            if not self._is_window_open:
                LOG.info("the window was closed")
                self._window.hide()  # the virtual camera uses its context
        if self._virtual_camera is not None:
            self._virtual_camera.draw(faps, now_s)

    def close(self) -> None:
        """Release the virtual camera."""
        if self._virtual_camera is not None:
            self._virtual_camera.close()


def _open_window(config: DriverConfig, on_switch: Callable[[int], None]) -> Window | None:
    has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if config.view == "none" or (config.view == "auto" and not has_display):
        return None
    from kouxing.services.driver.render.scene import load_head, parse_background, place_camera
    from kouxing.services.driver.render.window import Window  # glfw starts processes on import

    head = load_head(config.head, "coarse")  # smooth motion matters more than outlines
    try:
        return Window(
            head,
            *config.size_px,
            background=parse_background(config.background),
            camera=place_camera(head, config.camera),
            on_switch=on_switch,
        )
    except UserError as error:
        if config.view == "window":
            raise
        LOG.warning("cannot open a window: %s", error)
        return None
