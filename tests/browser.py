"""A headless Chromium with one page, of which pictures can be taken."""

from __future__ import annotations

import base64
import io
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kouxing.evaluation.system.chromium import Chromium, wait_until

SIZE_PX = (640, 480)


class Browser(Chromium):
    """A headless Chromium with a page of 640 x 480."""

    def __init__(self, folder: Path, microphone: Path, camera: Path | None = None) -> None:
        super().__init__(folder, SIZE_PX, microphone, camera)

    def steady_image(self) -> NDArray[np.uint8]:
        """Return the canvas once it no longer changes: every fade and redrawing is over."""
        images = [self.image()]

        def is_steady() -> bool:
            picture_ms = self.evaluate("window.kouxing?.state.drawing?.pictureMs ?? 0")
            time.sleep(0.05 + 3 * picture_ms / 1000)  # a busy machine needs time for an image
            images.append(self.image())
            return np.array_equal(images[-1], images[-2])

        wait_until(is_steady, 60)
        return images[-1]

    def image(self) -> NDArray[np.uint8]:
        """Return the canvas as it is seen: shape (height, width, 3)."""
        data = self.command("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB"))
