"""Checks of pages with kouxing-lips that hold in Chromium and in Firefox."""

import base64

import numpy as np
from numpy.typing import NDArray

from tests.browser import Browser
from tests.firefox import Firefox
from tests.system import ROOT

PACKAGE = ROOT / "clients" / "kouxing-lips"
NOTE = "document.getElementById('note').textContent"


def frames_of(browser: Browser | Firefox, samples: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the FAPs (F, 68) that the page's ``window.lips`` makes from 16 kHz sound (n,)."""
    sound = base64.b64encode(samples.astype("<f4").tobytes()).decode()
    faps = browser.evaluate(
        "(async () => { const all = [];"
        "const lips = window.lips;"
        "lips.addEventListener('frames', ({ detail }) => all.push(...detail.frames));"
        f"const bytes = Uint8Array.from(atob('{sound}'), (c) => c.charCodeAt(0));"
        "await lips.open(16000); lips.push(new Float32Array(bytes.buffer));"
        "await lips.finish(); return all.map(({ faps }) => [...faps]); })()"
    )
    return np.array(faps)


def check_sound_waits_for_a_click(browser: Browser | Firefox) -> None:
    play = "window.lips.listenTo(new AudioBuffer({ length: 48000, sampleRate: 48000 }))"
    browser.evaluate(f"{play}.then(() => 1)")
    assert "click on the page" in browser.evaluate(NOTE)
    browser.click("note")
    browser.wait_for("window.lips.context.state === 'running'")
    browser.wait_for(f"{NOTE} === ''")
