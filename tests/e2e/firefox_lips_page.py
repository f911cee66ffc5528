"""kouxing-lips in Firefox; ``make test-firefox`` runs this file.

No head is drawn, because a headless Firefox without a GPU has no WebGL.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.system.chromium import serve_folder
from kouxing.services.cli.web_model import web_model
from tests.e2e.lips_page import NOTE, PACKAGE, check_sound_waits_for_a_click, frames_of
from tests.firefox import Firefox
from tests.lips_package import faps_of
from tests.sound_server import sound_server
from tests.system import DEMO, samples_of_file

CODE = "index.js", "worker.js", "worklet.js", "frame-track.js", "engine"
PAGE = """<!doctype html><link rel="icon" href="data:,">
<button id="microphone">Microphone</button><button id="sample">Sample</button><p id="note"></p>
<script type="module">
import { LipSync } from "./index.js";
const [microphone, sample, note] =
  ["microphone", "sample", "note"].map((id) => document.getElementById(id));
const lips = window.lips = await LipSync.create();
window.delays = [];
window.opened = 0;
lips.addEventListener("notice", ({ detail }) => (note.textContent = detail));
lips.addEventListener("frames", ({ detail: { frames, startS } }) => {
  for (const { timeS, faps } of frames) {
    window.delays.push(lips.context.currentTime - startS - timeS);
    window.opened = Math.max(window.opened, -faps[3] - faps[4]);
  }
});
const act = (action) => async () => {
  try { await action(); } catch (error) { note.textContent = error.message; }
};
microphone.onclick = act(() => lips.listenToMicrophone());
sample.onclick = act(async () => {
  const bytes = await (await fetch("sample.wav")).arrayBuffer();
  await lips.listenTo(await lips.context.decodeAudioData(bytes));
});
window.isReady = true;
</script>"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    for name in CODE:
        (folder / name).symlink_to(PACKAGE / name)
    (folder / "models").mkdir()
    for name, content in web_model().items():
        (folder / "models" / name).write_bytes(content)
    (folder / "sample.wav").symlink_to(DEMO / "hello-female.wav")
    (folder / "index.html").write_text(PAGE)
    return folder


@pytest.fixture(autouse=True, scope="module")
def _sound_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Start a sound server, without which Firefox plays no sound."""
    with sound_server(tmp_path_factory.mktemp("sound")):
        yield


@pytest.fixture
def browser(tmp_path: Path, site: Path) -> Iterator[Firefox]:
    with Firefox(tmp_path / "profile") as browser, serve_folder(site) as origin:
        browser.open(f"{origin}/")
        browser.wait_for("window.isReady")
        yield browser


def test_a_recording_moves_the_lips_in_time(browser: Firefox) -> None:
    browser.click("sample")
    browser.wait_for("window.opened > 200 && window.delays.length > 250")
    delays_ms = 1e3 * np.array(browser.evaluate("window.delays"))
    print(f"delay p50 {np.median(delays_ms):.0f} ms, p95 {np.percentile(delays_ms, 95):.0f} ms")
    assert np.median(delays_ms) > 60


def test_the_microphone_sends_sound(browser: Firefox) -> None:
    """Firefox's fake microphone plays a tone, so only frames arrive."""
    browser.click("microphone")
    browser.wait_for("window.delays.length > 50")


def test_frames_equal_those_of_node(browser: Firefox, site: Path) -> None:
    samples = samples_of_file(DEMO / "lake-male.wav")
    faps = frames_of(browser, samples)
    np.testing.assert_allclose(faps, faps_of(site / "models", samples), atol=1e-3)


def test_sound_before_a_click_gives_a_notice(browser: Firefox) -> None:
    check_sound_waits_for_a_click(browser)


def test_a_blocked_microphone_gives_a_sentence(browser: Firefox) -> None:
    browser.evaluate(
        "void (navigator.mediaDevices.getUserMedia ="
        " () => Promise.reject(new DOMException('', 'NotAllowedError')))"
    )
    browser.click("microphone")
    browser.wait_for(f"{NOTE}.startsWith('the microphone is blocked; allow it')")
