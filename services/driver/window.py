"""Show a head in a window."""

from __future__ import annotations

from collections.abc import Callable

import glfw
import moderngl
import numpy as np
from numpy.typing import NDArray

from services.driver.head import Head
from services.driver.render import Renderer
from shared.errors import UserError

Float32 = NDArray[np.float32]


class Window:
    """A resizable window with a head in it.

    Parameters
    ----------
    head
        Whom to show.
    width_px, height_px
        Size at first.
    title
        Of the window.
    samples
        Anti-aliasing samples a pixel.

    Raises
    ------
    UserError
        If there is no display, or no OpenGL 3.3 on it.
    """

    def __init__(
        self,
        head: Head,
        width_px: int = 640,
        height_px: int = 480,
        *,
        title: str = "kouxing",
        samples: int = 4,
    ) -> None:
        glfw.ERROR_REPORTING = "ignore"  # the results are checked here
        if not glfw.init():
            raise UserError(
                "there is no display to open a window on; set DISPLAY, or write a video instead"
            )
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 3)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
        glfw.window_hint(glfw.SAMPLES, samples)
        self._window = glfw.create_window(width_px, height_px, title, None, None)
        if not self._window:
            glfw.terminate()
            raise UserError("the display offers no OpenGL 3.3; update its driver or install Mesa")
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        size = glfw.get_framebuffer_size(self._window)
        self._context = moderngl.create_context(require=330)
        self._renderer = Renderer(head, *size, context=self._context, on_screen=True)

    @property
    def context(self) -> moderngl.Context:
        """The window's OpenGL context, for renderers that draw beside it."""
        return self._context

    def draw(self, faps: Float32) -> bool:
        """Show one picture and handle what the user did to the window.

        Parameters
        ----------
        faps
            Facial animation parameters (68,), FAP units.

        Returns
        -------
        False once the user has closed the window.
        """
        glfw.poll_events()
        if glfw.window_should_close(self._window):
            return False
        width_px, height_px = glfw.get_framebuffer_size(self._window)
        if width_px and height_px:  # both 0 while iconified
            if (width_px, height_px) != self._renderer.size:
                self._renderer.resize(width_px, height_px)
            self._renderer.draw_on_screen(faps)
        glfw.swap_buffers(self._window)
        return True

    def follow(self, next_faps: Callable[[], Float32]) -> None:
        """Show what ``next_faps`` gives, at the display's rate, until the window is closed."""
        while self.draw(next_faps()):
            pass

    def hide(self) -> None:
        """Take the window off the screen; its context stays."""
        glfw.hide_window(self._window)

    def close(self) -> None:
        """Close the window."""
        glfw.destroy_window(self._window)
        glfw.terminate()
