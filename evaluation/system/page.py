"""Measures how the page draws, and its delay, in a headless Chromium.

The services run as under ``kouxing run``, on free ports. The processor draws the page, with
SwiftShader. First the face only idles. Then the page's microphone plays a recording in a loop. The
page reports its own figures in ``window.kouxing.state``. Its delay ends at the display's first
refresh after the picture was drawn.
"""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console

from kouxing.evaluation.system.chromium import Chromium, write_wav
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.errors import UserError

SIZE_PX = (1100, 800)
SETTLE_S = 12.0  # the page needs this to choose its resolution and its playout delay
MEASURE_S = 15.0


@dataclass(frozen=True, slots=True)
class Drawing:
    """Figures of the page in one situation."""

    pictures_per_s: float
    size_px: tuple[int, int]  # size of the drawn picture, in a page of SIZE_PX
    picture_ms: float  # from the start of drawing to its end
    picture_cpu_ms: float  # on all cores, compositing included
    voice_to_frame_ms: float | None  # until the frame has reached the page; None: no speech
    voice_to_picture_ms: float | None
    load: float  # load average of the last minute


def measure(path: Path, console: Console) -> dict[str, Drawing]:
    """Start the services and a browser; return the figures when idle and with the microphone.

    Raises ``UserError`` if the file is not audio, or the services or Chromium cannot start.
    """
    # Processes of Chromium may still write to the profile after it has ended.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        write_wav(folder / "voice.wav", *read_audio(path))
        with LocalSystem(folder, console) as system:
            browser = Chromium(folder / "profile", SIZE_PX, folder / "voice.wav")
            try:
                return _measure(browser, system.supervisor.page_address(system.control))
            except TimeoutError as error:
                raise UserError(f"the page did not respond in time: {error}") from None
            finally:
                browser.close()


def _measure(browser: Chromium, url: str) -> dict[str, Drawing]:
    browser.command("Page.navigate", url=url)
    browser.wait_for("document.getElementById('loading')?.hidden && window.kouxing.state.connected")
    idle = _measure_drawing(browser)
    browser.click("microphone")
    browser.wait_for("window.kouxing.state.voiceToImageMs !== null")
    return {"idle": idle, "microphone": _measure_drawing(browser)}


def _measure_drawing(browser: Chromium) -> Drawing:
    time.sleep(SETTLE_S)
    start_s, start_cpu_s = time.monotonic(), browser.cpu_s()
    states = [browser.evaluate("window.kouxing.state")]
    while time.monotonic() < start_s + MEASURE_S:
        time.sleep(1.0)
        states.append(browser.evaluate("window.kouxing.state"))
    duration_s, cpu_s = time.monotonic() - start_s, browser.cpu_s() - start_cpu_s
    drawings = [state["drawing"] for state in states]
    num_pictures = drawings[-1]["numImages"] - drawings[0]["numImages"]

    def median(key: str) -> float | None:
        values = [state[key] for state in states if state[key] is not None]
        return float(np.median(values)) if values else None

    return Drawing(
        pictures_per_s=num_pictures / duration_s,
        size_px=(drawings[-1]["width"], drawings[-1]["height"]),
        picture_ms=float(np.median([drawing["imageMs"] for drawing in drawings])),
        picture_cpu_ms=1e3 * cpu_s / max(1, num_pictures),
        voice_to_frame_ms=median("voiceToFrameMs"),
        voice_to_picture_ms=median("voiceToImageMs"),
        load=os.getloadavg()[0],
    )
