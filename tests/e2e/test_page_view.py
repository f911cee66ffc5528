"""The page over https, as a bare overlay, with a keyboard and with a screen reader."""

import base64
import io
from collections.abc import Iterator

import numpy as np
import pytest
from PIL import Image

from tests.browser import PAGE_IS_READY, Browser
from tests.fake_control import FakeControl
from tests.system import DEMO, Gateway

TOKEN = "#token=a%2Bsecret"  # noqa: S105 - of the test
CONTROLS = [
    *("head", "show-phones", "microphone", "sample", "open-file", "record", "learn", "sound"),
    "open-settings",
]


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    certificate = tmp_path_factory.mktemp("https") / "kouxing.pem"
    settings = {"https": str(certificate), "token": "a+secret"}
    with FakeControl() as control:
        gateway = Gateway(control.address, **settings)
        yield gateway
        assert gateway.stop() == 0


@pytest.fixture(scope="module")
def browser(gateway: Gateway, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("browser"), DEMO / "hello-female.wav")
    browser.command("Security.setIgnoreCertificateErrors", ignore=True)
    with browser.infrequent_drawing():
        yield browser
    browser.close()


def visit(browser: Browser, address: str) -> None:
    browser.command("Page.navigate", url="about:blank")
    browser.command("Page.navigate", url=address)


def test_the_token_is_used_and_removed_from_the_url(browser: Browser, gateway: Gateway) -> None:
    visit(browser, gateway.page)
    browser.wait_for("document.getElementById('notice')?.textContent.includes('#token=')")
    visit(browser, gateway.page + TOKEN)
    browser.wait_for(PAGE_IS_READY)
    assert browser.evaluate("location.href") == gateway.page
    browser.click("microphone")  # https gives access to the microphone
    browser.wait_for("window.kouxing.state.microphone")
    browser.click("microphone")
    browser.wait_for("!window.kouxing.state.microphone")


def press(browser: Browser, key: str) -> None:
    codes = {"Tab": 9, "Enter": 13, "Escape": 27}
    text = {"text": "\r"} if key == "Enter" else {}
    for kind in ("keyDown", "keyUp"):
        browser.command(
            "Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=codes[key], **text
        )


def test_the_keyboard_reaches_all_controls_with_a_visible_focus(
    browser: Browser, gateway: Gateway
) -> None:
    visit(browser, gateway.page + TOKEN)
    browser.wait_for(PAGE_IS_READY)
    reached = []
    for _ in CONTROLS:
        press(browser, "Tab")
        reached.append(browser.evaluate("document.activeElement.id"))
        outline = "getComputedStyle(document.activeElement).outlineStyle"
        assert browser.evaluate(outline) == "solid", reached[-1]
    assert reached == CONTROLS
    press(browser, "Enter")
    is_open = "document.getElementById('settings').matches(':popover-open')"
    browser.wait_for(is_open)
    press(browser, "Tab")
    assert browser.evaluate("document.activeElement.id") == "heads"
    press(browser, "Escape")
    browser.wait_for(f"!{is_open}")
    assert browser.evaluate("document.activeElement.id") == "open-settings"


def test_a_screen_reader_finds_names(browser: Browser, gateway: Gateway) -> None:
    visit(browser, gateway.page + TOKEN)
    browser.wait_for(PAGE_IS_READY)
    browser.evaluate("document.getElementById('settings').showPopover()")
    browser.command("Accessibility.enable")
    nodes = browser.command("Accessibility.getFullAXTree")["nodes"]
    shown = [node for node in nodes if not node.get("ignored")]
    named = {
        (node["role"]["value"], node["name"]["value"])
        for node in shown
        if "name" in node and "role" in node
    }
    assert ("meter", "level") in named
    sliders = sorted(name for role, name in named if role == "slider")
    assert sliders[0].startswith("Emotion from the voice")
    assert sliders[1].startswith("Mouth movement")
    for node in shown:
        if node["role"]["value"] in ("button", "combobox", "slider", "meter", "image"):
            assert node["name"]["value"], node
    # Elements that are announced when they change; the others change too often.
    live = browser.evaluate(
        "Array.from(document.querySelectorAll('[role=status], [role=alert], output, [aria-live]'))"
        ".filter((item) => item.getAttribute('aria-live') !== 'off').map((item) => item.id)"
    )
    announced = ["turned", "state", "notice", "behind", "send-problem"]
    announced += ["learn-advice", "learn-progress", "learn-problem"]
    assert live == announced


def test_the_bare_view_shows_only_the_face_on_a_transparent_background(
    browser: Browser, gateway: Gateway
) -> None:
    browser.resize(160, 120)
    visit(browser, f"{gateway.page}?view=bare&background=transparent{TOKEN}")
    browser.wait_for(PAGE_IS_READY)
    clear = {"r": 0, "g": 0, "b": 0, "a": 0}
    browser.command("Emulation.setDefaultBackgroundColorOverride", color=clear)
    browser.wait_for("window.kouxing.state.drawing.numImages > 0")
    data = browser.command("Page.captureScreenshot", format="png")["data"]
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
    browser.command("Emulation.setDefaultBackgroundColorOverride")
    height, width = alpha.shape
    assert alpha[:, [0, -1]].max() == 0
    assert alpha[height // 2, width // 2] == 255
    assert 0.1 < (alpha == 255).mean() < 0.8
    assert browser.evaluate("document.body.innerText.trim()") == ""
