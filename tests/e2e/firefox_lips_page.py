"""The demo page of kouxing-lips in Firefox; ``make test-firefox`` runs this file."""

import base64
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.system.chromium import serve_folder
from tests.e2e.test_lips_page import FACE, NOTE, PACKAGE
from tests.firefox import Firefox
from tests.process.test_lips_package import package_faps, read
from tests.system import DEMO, NODE


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "demo"
    subprocess.run([NODE, PACKAGE / "demo" / "build.mjs", folder], check=True, timeout=180)
    return folder


@pytest.fixture
def browser(tmp_path: Path, site: Path) -> Iterator[Firefox]:
    with Firefox(tmp_path / "profile") as browser, serve_folder(site) as origin:
        browser.open(f"{origin}/")
        browser.wait_for(f"{FACE}?.lips")
        browser.evaluate(f"{FACE}.lips.then((lips) => {{ window.lips = lips; return 1; }})")
        browser.evaluate(
            "(() => { window.delays = []; window.opened = 0;"
            "window.lips.addEventListener('frames', ({ detail: { frames, startS } }) => {"
            " for (const { timeS, faps } of frames) {"
            "  window.delays.push(window.lips.context.currentTime - startS - timeS);"
            "  window.opened = Math.max(window.opened, -faps[3] - faps[4]); } }); })()"
        )
        yield browser


def test_a_recording_moves_the_lips_in_time(browser: Firefox) -> None:
    browser.click("sample")
    browser.wait_for("window.opened > 200 && window.delays.length > 200")
    delays_ms = 1e3 * np.array(browser.evaluate("window.delays"))
    print(f"delay p50 {np.median(delays_ms):.0f} ms, p95 {np.percentile(delays_ms, 95):.0f} ms")
    assert np.median(delays_ms) > 60


def test_the_microphone_sends_sound(browser: Firefox) -> None:
    """Firefox's fake microphone plays a tone, so only frames arrive."""
    browser.click("microphone")
    browser.wait_for("window.delays.length > 50")
    browser.click("microphone")
    assert browser.evaluate("document.getElementById('microphone').ariaPressed") == "false"


def test_frames_equal_those_of_node(browser: Firefox, site: Path) -> None:
    samples = read(DEMO / "lake-male.wav")
    sound = base64.b64encode(samples.astype("<f4").tobytes()).decode()
    faps = browser.evaluate(
        "(async () => { const all = [];"
        "window.lips.addEventListener('frames', ({ detail }) => all.push(...detail.frames));"
        f"const bytes = Uint8Array.from(atob('{sound}'), (c) => c.charCodeAt(0));"
        "await window.lips.open(16000); window.lips.push(new Float32Array(bytes.buffer));"
        "await window.lips.finish(); return all.map(({ faps }) => [...faps]); })()"
    )
    expected = package_faps(site / "modules" / "kouxing-lips" / "models", samples)
    np.testing.assert_allclose(np.array(faps), expected, atol=1e-3)


def test_sound_before_a_click_gives_a_notice(browser: Firefox) -> None:
    play = "window.lips.listenTo(new AudioBuffer({ length: 48000, sampleRate: 48000 }))"
    browser.evaluate(f"{play}.then(() => 1)")
    assert "click on the page" in browser.evaluate(NOTE)
    browser.click("note")
    browser.wait_for("window.lips.context.state === 'running'")


def test_a_blocked_microphone_gives_a_sentence(browser: Firefox) -> None:
    browser.evaluate(
        "void (navigator.mediaDevices.getUserMedia ="
        " () => Promise.reject(new DOMException('', 'NotAllowedError')))"
    )
    browser.click("microphone")
    browser.wait_for(f"{NOTE}.startsWith('the microphone is blocked; allow it')")
