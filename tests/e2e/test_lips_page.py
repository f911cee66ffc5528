"""The demo page of kouxing-lips in Chromium: lip sync without a server."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kouxing.evaluation.system.chromium import serve_folder
from kouxing.services.cli.web_model import web_model
from kouxing.services.driver.head.glb_export import export_glb
from tests import heads
from tests.browser import Browser
from tests.e2e.lips_page import NOTE, PACKAGE, check_sound_waits_for_a_click, frames_of
from tests.lips_package import faps_of
from tests.system import DEMO, HELLO, NODE

SIZE_PX = (320, 480)  # heads are drawn without a GPU
FACE = "document.getElementById('face')"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "demo"
    subprocess.run([NODE, PACKAGE / "demo" / "build.mjs", folder], check=True, timeout=180)
    export_glb(heads.load("woman", "coarse"), folder / "heads" / "woman.glb")  # drawn faster
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(
        tmp_path_factory.mktemp("browser"), DEMO / "hello-female.wav", size_px=SIZE_PX
    )
    with browser.infrequent_drawing("/modules/kouxing-client/page/draw-rate.js"):
        yield browser
    browser.close()


def open_demo(browser: Browser, origin: str) -> None:
    browser.restart(f"{origin}/")
    browser.wait_for(f"{FACE}?.set != null")
    browser.evaluate(f"{FACE}.lips.then((lips) => {{ window.lips = lips; return 1; }})")
    browser.evaluate(
        f"window.notices = []; {FACE}.addEventListener('notice',"
        " ({ detail }) => window.notices.push(detail)); 1"
    )
    browser.evaluate(
        "window.opened = 0; window.lips.addEventListener('frames', ({ detail: { frames } }) => {"
        " for (const { faps } of frames)"
        " window.opened = Math.max(window.opened, -faps[3] - faps[4]); })"
    )


@pytest.fixture(scope="module")
def demo(browser: Browser, site: Path) -> Iterator[Browser]:
    """The browser with a demo page for the next tests: loading one takes long."""
    with serve_folder(site) as origin:
        open_demo(browser, origin)
        yield browser


def test_calls_without_sound_and_replaced_sources_are_reported(demo: Browser) -> None:
    demo.evaluate("window.lips.express({ joy: 1 }); 1")
    demo.wait_for("window.notices.includes('no sound is open; call open() or listenTo() first')")
    push = "window.lips.push(new Float32Array(320))"
    for call in (f"(async () => {push})()", "window.lips.finish()"):
        text = demo.evaluate(f"{call}.catch(({{ message }}) => message)")
        assert text == "no sound is open for push(); call open(), and wait until it has opened"
    result = demo.evaluate(
        "Promise.allSettled([window.lips.open(16000), window.lips.open(48000)])"
        ".then((all) => all.map(({ status, reason }) => reason?.name ?? status))"
    )
    assert result == ["AbortError", "fulfilled"]


def test_the_page_fits_on_a_phone(demo: Browser) -> None:
    demo.resize(*SIZE_PX, mobile=True)
    demo.evaluate("new Promise((done) => requestAnimationFrame(() => done(1)))")
    size = demo.evaluate("[innerWidth, innerHeight]")
    demo.resize(*SIZE_PX)
    assert size == [*SIZE_PX]


def test_the_microphone_moves_a_face(demo: Browser) -> None:
    demo.click("microphone")
    demo.wait_for("window.opened > 200")
    demo.wait_for("document.getElementById('phones').textContent.split(' ').length > 4")
    demo.wait_for(f"{FACE}.shown && {FACE}.shown[2] > 20")
    demo.click("microphone")
    assert demo.evaluate("document.getElementById('microphone').ariaPressed") == "false"
    demo.wait_for(f"Math.abs({FACE}.shown[2]) < 1")  # the face returns to rest
    assert not [text for text in demo.page_errors if "GL Driver" not in text]


def test_other_lip_sync_is_shown_on_the_same_sound(demo: Browser) -> None:
    faces = "[...document.querySelectorAll('kouxing-face')]"
    click = "document.getElementById('compare').click();"
    demo.evaluate(f"{click * 3} 1")  # on, off and on again, while the packages load
    demo.wait_for(f"{faces}.length === 3 && {faces}.every(({{ set }}) => set === 'faps')")
    demo.evaluate(
        "window.jaws = [0, 0, 0]; window.timer = setInterval(() => "
        f"{faces}.forEach((face, i) => {{ const jaw = face.shown?.[2] ?? 0;"
        " window.jaws[i] = Math.max(window.jaws[i], jaw); }), 20); 1"
    )
    demo.click("microphone")
    demo.wait_for("window.jaws.every((jaw) => jaw > 10)")
    demo.click("microphone")
    demo.evaluate("clearInterval(window.timer)")
    demo.click("compare")
    demo.wait_for(f"{faces}.length === 1")
    assert not [text for text in demo.page_errors if "GL Driver" not in text]


def test_an_avatar_speaks(demo: Browser, site: Path) -> None:
    export_glb(heads.load("mika", "coarse"), site / "avatar.vrm")
    demo.evaluate(f"{FACE}.setAttribute('src', 'avatar.vrm')")
    demo.wait_for(f"['vrm', 'arkit'].includes({FACE}.set)")
    demo.click("microphone")
    demo.wait_for(f"({FACE}.shown?.jawOpen ?? {FACE}.shown?.aa) > 0.05")
    demo.click("microphone")


def test_notices_about_the_microphone_and_the_tab(demo: Browser) -> None:
    def wait_for_notice(start: str) -> None:
        demo.wait_for(f"window.notices.some((text) => text.startsWith('{start}'))")

    def set_hidden(is_hidden: str) -> None:
        demo.evaluate(
            f"Object.defineProperty(document, 'hidden', {{ value: {is_hidden}, writable: true }});"
            "document.dispatchEvent(new Event('visibilitychange')); 1"
        )

    demo.evaluate(
        "MediaStreamTrack.prototype.getSettings = function () {"
        " window.track = this; return { sampleRate: 8000 }; }; 1"
    )
    demo.click("microphone")
    wait_for_notice("the microphone sends 8 kHz")
    demo.wait_for("window.lips.node !== null")  # the face follows it
    set_hidden("true")
    wait_for_notice("the tab is in the background")
    demo.evaluate("window.lips.context.suspend().then(() => 1)")  # as phones do
    set_hidden("false")
    demo.wait_for("window.lips.context.state === 'running'")
    demo.evaluate("window.opened = 0")
    demo.wait_for("window.opened > 200")
    demo.evaluate("window.track.dispatchEvent(new Event('ended'))")
    wait_for_notice("the microphone was unplugged")


def test_frames_in_the_browser_equal_those_of_node(demo: Browser, tmp_path: Path) -> None:
    samples = HELLO[:9600]  # the block network is slow here
    for name, content in web_model().items():
        (tmp_path / name).write_bytes(content)
    first = frames_of(demo, samples)
    demo.click("final")
    demo.wait_for("document.getElementById('final').ariaPressed === 'true'")
    demo.evaluate(f"{FACE}.lips.then((lips) => {{ window.lips = lips; return 1; }})")
    final = frames_of(demo, samples)
    np.testing.assert_allclose(first, faps_of(tmp_path, samples, phones=True), atol=1e-3)
    np.testing.assert_allclose(final, faps_of(tmp_path, samples, phones="final"), atol=1e-3)


def test_each_problem_gives_a_sentence(demo: Browser) -> None:
    def wait_for_note(text: str) -> None:
        demo.wait_for(f"{NOTE}.includes('{text}')")

    for name, text in (
        ("speech.txt", "the browser cannot read this file"),
        ("avatar.vrm", "it is not a GLB or VRM file"),
    ):
        demo.evaluate(
            "window.drop = new Event('drop', { bubbles: true });"
            f"drop.dataTransfer = {{ files: [new File(['text'], '{name}')] }};"
            "document.body.dispatchEvent(drop); 1"
        )
        wait_for_note(text)
    for error, text in (
        ("NotAllowedError", "the microphone is blocked; allow it"),
        ("NotFoundError", "no microphone was found"),
    ):
        demo.evaluate(
            "navigator.mediaDevices.getUserMedia ="
            f" () => Promise.reject(new DOMException('', '{error}')); 1"
        )
        demo.click("microphone")
        wait_for_note(text)
    demo.evaluate("delete navigator.mediaDevices.getUserMedia")
    hidden = "{ value: undefined, configurable: true }"
    demo.evaluate(f"Object.defineProperty(navigator, 'mediaDevices', {hidden}); 1")
    demo.click("microphone")
    wait_for_note("open it by https")
    demo.evaluate("delete navigator.mediaDevices")


def test_the_page_works_offline_after_the_first_visit(browser: Browser, site: Path) -> None:
    with serve_folder(site) as origin:
        open_demo(browser, origin)
        browser.evaluate("navigator.serviceWorker.ready.then(() => 1)")
        browser.wait_for("navigator.serviceWorker.controller !== null")
        browser.show_nothing()
    open_demo(browser, origin)
    check_sound_waits_for_a_click(browser)
    browser.click("sample")
    browser.wait_for("window.opened > 200")
