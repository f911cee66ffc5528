"""Measures lip sync in the browser: ``kouxing-lips`` in headless Chromium, without a drawn head.

The microphone plays a recording in a loop. The delay of a frame is the time from its sound in the
audio thread to its weights in the page. The processor time is that of the page's process: page,
worker and audio thread.
"""

from __future__ import annotations

import gzip
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from kouxing.evaluation.system.chromium import Chromium, serve_folder, write_microphone
from kouxing.services.cli.web_model import web_model
from kouxing.shared.errors import UserError
from kouxing.shared.terminal import print_table

MEASURE_S = 20.0
_SIZE_PX = (400, 300)
_CODE = ("index.js", "worker.js", "worklet.js", "frame-track.js", "engine")
_DOWNLOAD = ("*.js", "engine/*.js", "models/*")
_PAGE = """<!doctype html><link rel="icon" href="data:,"><button id="start">Start</button>
<script type="module">
import { LipSync } from "./index.js";
window.delays = [];
document.getElementById("start").onclick = async () => {
  const startMs = performance.now();
  const lips = await LipSync.create();
  window.loadedMs = performance.now() - startMs;
  lips.addEventListener("frames", ({ detail: { frames, startS } }) => {
    for (const { timeS, faps } of frames) {
      window.delays.push(lips.context.currentTime - startS - timeS);
      if (-faps[3] - faps[4] > 100) window.movedMs ??= performance.now() - startMs;
    }
  });
  await lips.listenToMicrophone();
  window.startedMs = performance.now() - startMs;
};
window.isReady = true;
</script>"""


@dataclass(frozen=True, slots=True)
class LipsPage:
    """Figures of lip sync in the browser."""

    download_bytes: int  # code and models, compressed by gzip
    loaded_ms: float  # models and worker, from a local server
    first_movement_ms: float  # of the mouth, from the start of loading; the microphone speaks
    delay_ms: dict[str, float]  # from the sound to its weights: p50, p95
    processor_share: float  # of one core


def measure(audio: Path, package: Path) -> LipsPage:
    """Measure the package in a folder; raise ``UserError`` if Chromium is not installed."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for file in _CODE:
            if not (package / file).exists():
                raise UserError(f"{package} is not a folder of kouxing-lips: it has no {file}")
            (folder / file).symlink_to((package / file).resolve())
        (folder / "models").mkdir()
        for file, content in web_model().items():
            (folder / "models" / file).write_bytes(content)
        (folder / "index.html").write_text(_PAGE, encoding="utf-8")
        voice = folder / "voice.wav"
        write_microphone(audio, voice)
        files = (path for pattern in _DOWNLOAD for path in folder.glob(pattern))
        size = sum(len(gzip.compress(path.read_bytes())) for path in files)
        browser = Chromium(folder / "profile", _SIZE_PX, voice)
        try:
            with serve_folder(folder) as origin:
                return _measure(browser, origin, size)
        except TimeoutError as error:
            raise UserError(f"the page did not respond in time: {error}") from None
        finally:
            browser.close()


def _measure(browser: Chromium, origin: str, download_bytes: int) -> LipsPage:
    browser.command("Page.navigate", url=origin)
    browser.wait_for("window.isReady")
    browser.click("start")
    browser.wait_for("window.movedMs && window.startedMs")
    browser.evaluate("window.delays.length = 0")
    start_s, start_cpu_s = time.monotonic(), browser.cpu_s("renderer")
    time.sleep(MEASURE_S)
    duration_s, cpu_s = time.monotonic() - start_s, browser.cpu_s("renderer") - start_cpu_s
    delays_ms = 1e3 * np.array(browser.evaluate("window.delays"))
    return LipsPage(
        download_bytes=download_bytes,
        loaded_ms=browser.evaluate("window.loadedMs"),
        first_movement_ms=browser.evaluate("window.movedMs"),
        delay_ms={f"p{p}": float(np.percentile(delays_ms, p)) for p in (50, 95)},
        processor_share=cpu_s / duration_s,
    )


def show(page: LipsPage, console: Console) -> None:
    """Print the figures as a table."""
    columns = ("download MB", "loaded ms", "first movement ms", "delay p50 ms", "p95 ms", "core %")
    row = [
        f"{page.download_bytes / 1e6:.2f}",
        f"{page.loaded_ms:.0f}",
        f"{page.first_movement_ms:.0f}",
        f"{page.delay_ms['p50']:.0f}",
        f"{page.delay_ms['p95']:.0f}",
        f"{100 * page.processor_share:.1f}",
    ]
    print_table(console, "", columns, [row])
