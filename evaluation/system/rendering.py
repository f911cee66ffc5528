"""Cost of an image: the stages of the renderer, the encoder, and the file of the head."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.services.driver.head.head import ASSETS, DEFAULT_HEAD, Detail, Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video.writer import VideoWriter
from kouxing.shared.face.high_level import VISEMES

NUM_IMAGES = 60
# name, detail, size, anti-aliasing samples per pixel, whether the images are encoded (H.264)
CASES: tuple[tuple[str, Detail, tuple[int, int], int, bool], ...] = (
    ("live, coarse head, 640x480", "coarse", (640, 480), 0, False),
    ("video, fine head, 1280x720, 4x anti-aliased", "fine", (1280, 720), 4, True),
)


@dataclass(frozen=True, slots=True)
class Rendering:
    """Figures of one run."""

    opengl: str  # renderer and version
    images_per_s: dict[str, float]  # by case, without encoding
    stages_ms: dict[str, dict[str, float]]  # median, by case and stage
    asset_bytes: int
    load_s: dict[str, float]  # by detail


def measure() -> Rendering:
    """Render the default head with visemes, blinks and nods.

    Raises
    ------
    UserError
        If OpenGL is not available.
    """
    rates, stages = {}, {}
    load_s: dict[str, float] = {}
    opengl = ""
    for name, detail, size, samples, encoded in CASES:
        start_s = time.perf_counter()
        head = Head.load(detail=detail)
        load_s[detail] = time.perf_counter() - start_s
        renderer = Renderer(head, *size, samples=samples)
        opengl = renderer.description
        frames = [_frame(number) for number in range(NUM_IMAGES)]
        images = [renderer.draw(faps) for faps in frames[:10]]  # warm up
        start_s = time.perf_counter()
        for faps in frames:
            renderer.draw(faps)
        rates[name] = NUM_IMAGES / (time.perf_counter() - start_s)
        times_s = [renderer.stages_s(faps) for faps in frames]
        stages[name] = {
            stage: 1e3 * float(np.median([stages_s[stage] for stages_s in times_s]))
            for stage in times_s[0]
        }
        if encoded:
            stages[name]["encode"] = _encode_ms(images)
        renderer.close()
    size_bytes = (ASSETS / f"{DEFAULT_HEAD}.npz").stat().st_size
    return Rendering(opengl, rates, stages, size_bytes, load_s)


def show(rendering: Rendering, console: Console) -> None:
    """Print the figures as a table."""
    names = list(dict.fromkeys(stage for ms in rendering.stages_ms.values() for stage in ms))
    table = Table(f"rendering with {rendering.opengl}", "images per s", *(f"{n} ms" for n in names))
    for case, rate in rendering.images_per_s.items():
        ms = rendering.stages_ms[case]
        table.add_row(case, f"{rate:.0f}", *(f"{ms[n]:.1f}" if n in ms else "" for n in names))
    console.print(table)
    loading = ", ".join(f"{detail} {took:.2f} s" for detail, took in rendering.load_s.items())
    console.print(f"the head: {rendering.asset_bytes / 1e6:.2f} MB, load time: {loading}")


def _frame(number: int) -> NDArray[np.float32]:
    """Return the FAPs (68,) of an image: one viseme after another, blinks and nods."""
    amount = np.float32(0.5 - 0.5 * np.cos(number * 0.7))
    faps: NDArray[np.float32] = VISEMES[1 + number // 5 % 14] * amount
    faps[18:20] = 500 * amount
    faps[47] = 3000 * np.sin(number * 0.3)
    return faps


def _encode_ms(images: list[NDArray[np.uint8]]) -> float:
    height_px, width_px = images[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        with VideoWriter(Path(folder) / "bench.mp4", width_px, height_px, 25.0, None) as writer:
            start_s = time.perf_counter()
            for number in range(NUM_IMAGES):
                writer.write_image(images[number % len(images)])
        return 1e3 * (time.perf_counter() - start_s) / NUM_IMAGES
