"""How the page draws, and what it makes late, in a headless Chromium.

The services run as under ``kouxing run``, on ports of their own; the processor draws, with
SwiftShader. First the face only idles, then a microphone hears a recording again and again. The
page measures itself (``window.kouxing.state``): the delay ends with the display's tick after a
picture is drawn. At last the recording is heard, with clicks in it: how far from their pictures?
"""

from __future__ import annotations

import os
import tempfile
import time
import wave
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system import sync
from kouxing.evaluation.system.chromium import Chromium
from kouxing.evaluation.system.live import NUM_TRIES, speak
from kouxing.evaluation.system.systems import LocalSystem
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.audio_file import read_audio
from kouxing.shared.client import Client
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

SIZE_PX = (1100, 800)
SETTLE_S = 12.0  # until the page has found how finely it can draw, and for how long to wait
MEASURE_S = 15.0
CLICK_EVERY = MEDIA_RATE_HZ // 2  # samples


@dataclass(frozen=True, slots=True)
class Drawing:
    """Figures of one run, ready for a table or JSON."""

    pictures_per_s: float
    size_px: tuple[int, int]  # that is drawn, for a page of SIZE_PX
    picture_ms: float  # from its begin to its end
    picture_cpu_ms: float  # of all cores, with putting it on the screen
    voice_to_frame_ms: float | None  # until the frame is in the page; None: nobody spoke
    voice_to_picture_ms: float | None
    load: float  # average of this machine's processes that run, over a minute


@dataclass(frozen=True, slots=True)
class Figures:
    """How the page draws, idling and with its microphone, and how sound and picture meet."""

    drawings: dict[str, Drawing]
    offsets: sync.Offsets


def measure(path: Path, console: Console) -> Figures:
    """Start the services and a browser; return the figures.

    Raises
    ------
    UserError
        If the file is no audio, the services cannot start, or no Chromium is installed.
    """
    samples, rate_hz = read_audio(path)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with wave.open(str(folder / "voice.wav"), "wb") as voice:
            voice.setparams((samples.shape[1], 2, rate_hz, 0, "NONE", ""))
            voice.writeframes((samples * 32767).astype("<i2").tobytes())
        with LocalSystem(folder, console) as system:
            browser = Chromium(folder / "profile", SIZE_PX, folder / "voice.wav")
            try:
                sync.install(browser)
                drawings = _draw(browser, system.supervisor.page_address(system.control))
                with Client(system.control) as client:
                    offsets = _hear(browser, client, to_16_khz(samples, rate_hz))
                return Figures(drawings, offsets)
            except TimeoutError as error:
                raise UserError(f"the page did not get there: {error}") from None
            finally:
                browser.close()


def show(figures: Figures, console: Console) -> None:
    """Print the figures as tables."""
    columns = ("pictures per s", "size", "ms", "CPU ms", "voice to frame", "to picture", "load")
    table = Table("page of {} x {}".format(*SIZE_PX), *columns)
    for name, drawing in figures.drawings.items():
        delays = (drawing.voice_to_frame_ms, drawing.voice_to_picture_ms)
        table.add_row(
            name,
            f"{drawing.pictures_per_s:.1f}",
            "{} x {}".format(*drawing.size_px),
            f"{drawing.picture_ms:.0f}",
            f"{drawing.picture_cpu_ms:.0f}",
            *("" if delay is None else f"{delay:.0f} ms" for delay in delays),
            f"{drawing.load:.1f}",
        )
    console.print(table)
    sync.show(figures.offsets, console)


def _draw(browser: Chromium, url: str) -> dict[str, Drawing]:
    browser.command("Page.navigate", url=url)
    browser.wait_for("document.getElementById('loading')?.hidden && window.kouxing.state.connected")
    idle = _drawing(browser)
    browser.click("microphone")
    browser.wait_for("window.kouxing.state.voiceToPictureMs !== null")
    drawings = {"idle": idle, "microphone": _drawing(browser)}
    browser.click("microphone")
    browser.wait_for("!window.kouxing.state.microphone && window.kouxing.state.sound === 'on'")
    return drawings


def _hear(browser: Chromium, client: Client, voice: NDArray[np.float32]) -> sync.Offsets:
    """Let a voice be heard, softly, and clicks; return how far they are from their pictures.

    Raises
    ------
    UserError
        If none is heard near its picture each time.
    """
    sound = np.resize(0.1 * voice / np.abs(voice).max(), round((SETTLE_S + MEASURE_S) * 16000))
    sound[CLICK_EVERY::CLICK_EVERY] = 0.6
    for _ in range(NUM_TRIES):
        session = client.open_session(encoding="f32le")
        browser.wait_for(f"window.kouxing.state.session === '{session.name}'")
        sync.begin(browser)
        speak([session], sound)
        session.close()
        clicks_ms, pictures = sync.read(browser)
        seen_ms = sync.passages_ms(pictures, CLICK_EVERY)
        settled_ms = clicks_ms[clicks_ms - clicks_ms[:1] >= 1e3 * SETTLE_S]
        if offsets := sync.offsets_ms(settled_ms, seen_ms):
            return sync.summary(offsets)
    raise UserError("no click is heard near its picture; this machine is too busy")


def _drawing(browser: Chromium) -> Drawing:
    time.sleep(SETTLE_S)
    begin_s, begin_cpu_s = time.monotonic(), browser.cpu_s()
    states = [browser.evaluate("window.kouxing.state")]
    while time.monotonic() < begin_s + MEASURE_S:
        time.sleep(1.0)
        states.append(browser.evaluate("window.kouxing.state"))
    took_s, cpu_s = time.monotonic() - begin_s, browser.cpu_s() - begin_cpu_s
    drawn = [state["drawing"] for state in states]
    num_pictures = drawn[-1]["numPictures"] - drawn[0]["numPictures"]

    def median(key: str) -> float | None:
        known = [state[key] for state in states if state[key] is not None]
        return float(np.median(known)) if known else None

    return Drawing(
        pictures_per_s=num_pictures / took_s,
        size_px=(drawn[-1]["width"], drawn[-1]["height"]),
        picture_ms=float(np.median([each["pictureMs"] for each in drawn])),
        picture_cpu_ms=1e3 * cpu_s / max(1, num_pictures),
        voice_to_frame_ms=median("voiceToFrameMs"),
        voice_to_picture_ms=median("voiceToPictureMs"),
        load=os.getloadavg()[0],
    )
