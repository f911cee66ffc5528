"""A headless Chromium with one page, and screenshots of that page."""

import base64
import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kouxing.evaluation.system.chromium import Chromium
from tests.system import wait_until

SIZE_PX = (480, 360)
IS_CURRENT = "window.kouxing?.state.drawing?.isCurrent ?? true"
AFTER_TWO_FRAMES = (
    "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))"
)
PAGE_IS_READY = "document.getElementById('loading')?.hidden && window.kouxing.state.connected"


class Browser(Chromium):
    """A headless Chromium with one page."""

    def __init__(
        self,
        folder: Path,
        microphone: Path,
        camera: Path | None = None,
        size_px: tuple[int, int] = SIZE_PX,
    ) -> None:
        """Start the browser. In a window that is too low, it draws one image a second."""
        super().__init__(folder, size_px, microphone, camera)

    def open(self, address: str) -> None:
        """Load the gateway's page."""
        self.command("Page.navigate", url=address)
        self.wait_for(PAGE_IS_READY)

    def restart(self, address: str) -> None:
        """Load a page of another origin, without the errors of the previous page."""
        self.show_nothing()
        self.page_errors.clear()
        self.command("Page.navigate", url=address)

    def show_nothing(self) -> None:
        """Leave the page, which would need processor time to draw its faces."""
        self.command("Page.navigate", url="about:blank")
        self.wait_for("location.href === 'about:blank'")

    @contextlib.contextmanager
    def infrequent_drawing(self, module: str = "/draw-rate.js") -> Iterator[None]:
        """Let pages draw one image in two seconds: without a GPU, an image needs 0.2 s.

        This applies to the shown page, and to pages that are opened in the meantime. ``module`` is
        the address of draw-rate.js.
        """
        source = (
            "location.protocol.startsWith('http') &&"
            f" import('{module}').then(({{ ImageQueue: {{ prototype }} }}) => {{"
            "   const { draw } = prototype;"
            "   prototype.draw = function (nowMs, ...functions) {"
            "     if (nowMs < (this.nextMs ?? 0)) return;"
            "     this.nextMs = nowMs + 2000;"
            "     draw.call(this, nowMs, ...functions); };"
            "   window.drawOften = () => { prototype.draw = draw; }; })"
        )
        self.command("Page.enable")
        script = self.command("Page.addScriptToEvaluateOnNewDocument", source=source)
        self.evaluate(source)
        yield
        self.evaluate("window.drawOften?.()")
        self.command("Page.removeScriptToEvaluateOnNewDocument", **script)
        self.command("Page.disable")

    def keep_resolution(self) -> None:
        """Let the gateway's page draw all further images with the same number of pixels."""
        self.evaluate(
            "import('/draw-rate.js').then(({ DrawRate: { prototype } }) => {"
            " const { recordDrawn } = prototype;"
            " prototype.recordDrawn = function (...times) {"
            "   recordDrawn.apply(this, times); this.ratio = 0.5; }; })"
        )
        for key in ("ArrowLeft", "Home"):  # each turns the head, which draws an image
            num_before = self.evaluate("window.kouxing.state.drawing.numImages")
            self.evaluate(
                "document.getElementById('head')"
                f".dispatchEvent(new KeyboardEvent('keydown', {{ key: '{key}' }}))"
            )
            self.wait_for(f"window.kouxing.state.drawing.numImages > {num_before}")

    def steady_image(self) -> NDArray[np.uint8]:
        """Return the canvas once every fade and redrawing is over."""
        images = [np.zeros(0, np.uint8)]

        def is_steady() -> bool:
            self.evaluate(AFTER_TWO_FRAMES)
            self.wait_for(IS_CURRENT)
            images.append(self.image())
            return bool(self.evaluate(IS_CURRENT)) and np.array_equal(images[-1], images[-2])

        wait_until(is_steady)
        return images[-1]

    def image(self) -> NDArray[np.uint8]:
        """Return the canvas as it is seen: shape (height, width, 3)."""
        data = self.command("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB"))
