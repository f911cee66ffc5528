"""Shows a head in a desktop window."""

import re
from collections.abc import Callable

import glfw
import moderngl

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import BACKGROUND, Background, Camera, Renderer
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError

TITLE = "kouxing"


class Window:
    """A resizable window with a head; edges are anti-aliased if there is a graphics card.

    ``on_switch`` is called with 1 (Tab, right arrow, click) or -1 (Shift+Tab, left arrow).

    Raises ``UserError`` if there is no display, or the display has no OpenGL 3.3.
    """

    def __init__(
        self,
        head: Head,
        width_px: int,
        height_px: int,
        *,
        background: Background = BACKGROUND,
        camera: Camera | None = None,
        on_switch: Callable[[int], None] = lambda _step: None,
    ) -> None:
        self._on_switch = on_switch
        self._caption = ""
        glfw.ERROR_REPORTING = "ignore"  # results are checked below
        if not glfw.init():
            raise UserError("no display for a window; set DISPLAY, or write a video instead")
        self._open(width_px, height_px, num_samples=0)
        if not re.search("llvmpipe|softpipe", str(self.context.info["GL_RENDERER"])):
            glfw.destroy_window(self._window)
            self._open(width_px, height_px, num_samples=4)
        size = glfw.get_framebuffer_size(self._window)
        self._renderer = Renderer(
            head, *size,
            background=background, camera=camera, context=self.context, on_screen=True,
        )  # fmt: skip
        glfw.set_key_callback(self._window, self._on_key)
        glfw.set_mouse_button_callback(self._window, self._on_mouse_button)

    def _open(self, width_px: int, height_px: int, num_samples: int) -> None:
        for hint, value in (
            (glfw.CONTEXT_VERSION_MAJOR, 3), (glfw.CONTEXT_VERSION_MINOR, 3),
            (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE), (glfw.OPENGL_FORWARD_COMPAT, True),
            (glfw.SAMPLES, num_samples),
        ):  # fmt: skip
            glfw.window_hint(hint, value)
        self._window = glfw.create_window(width_px, height_px, TITLE, None, None)
        if not self._window:
            glfw.terminate()
            raise UserError("the display has no OpenGL 3.3; update its driver or install Mesa")
        glfw.make_context_current(self._window)
        glfw.swap_interval(1)
        self.context = moderngl.create_context(require=330)  # other renderers can share it

    def draw(self, faps: Floats) -> bool:
        """Show FAPs (68,) and process user input; return False after the window was closed."""
        glfw.poll_events()
        if glfw.window_should_close(self._window):
            return False
        width_px, height_px = glfw.get_framebuffer_size(self._window)
        if width_px and height_px:  # both are 0 while minimized
            if (width_px, height_px) != self._renderer.size:
                self._renderer.resize(width_px, height_px)
            self._renderer.draw_on_screen(faps)
        glfw.swap_buffers(self._window)
        return True

    def set_caption(self, caption: str) -> None:
        """Show a caption after the program's name in the title."""
        if caption != self._caption:
            self._caption = caption
            glfw.set_window_title(self._window, f"{TITLE}: {caption}" if caption else TITLE)

    def hide(self) -> None:
        """Hide the window; its context stays valid."""
        glfw.hide_window(self._window)

    def close(self) -> None:
        """Close the window."""
        glfw.destroy_window(self._window)
        glfw.terminate()

    def _on_key(self, _window: object, key: int, _code: int, action: int, modifiers: int) -> None:
        if action == glfw.RELEASE:
            return
        if key == glfw.KEY_LEFT or (key == glfw.KEY_TAB and modifiers & glfw.MOD_SHIFT):
            self._on_switch(-1)
        elif key in (glfw.KEY_RIGHT, glfw.KEY_TAB):
            self._on_switch(1)

    def _on_mouse_button(self, _window: object, _button: int, action: int, _modifiers: int) -> None:
        if action == glfw.PRESS:
            self._on_switch(1)
