"""Examples that use the gateway: the voice assistant and the avatar in a browser."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client

from kouxing.evaluation.system.chromium import serve_folder
from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.face.shapes import ARKIT
from kouxing.shared.wire.session import FlushSession
from tests import heads
from tests.browser import Browser
from tests.e2e.page_control import PageControl
from tests.system import DEMO, LIMIT_S, ROOT, Gateway, start_python, wait_until

EXAMPLES = ROOT / "examples"
LONG_QUESTION = "a very long question " * 10  # its answer takes longer than the interruption


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The example's page with an avatar; yields the origin."""
    folder = tmp_path_factory.mktemp("site")
    for file in (EXAMPLES / "browser-vrm").iterdir():
        (folder / file.name).symlink_to(file)
    export_glb(heads.load("woman", "coarse"), folder / "avatar.vrm")
    with serve_folder(folder) as origin:
        yield origin


@pytest.fixture(scope="module")
def gateway(control: PageControl, site: str) -> Iterator[str]:
    """The gateway's address, with its token."""
    gateway = Gateway(control.address, trusted_origins=site, token="secret")
    wait_until(lambda: control.heartbeats)
    yield gateway.page.replace("http", "ws") + "?token=secret"
    assert gateway.stop() == 0


def test_the_assistant_can_be_interrupted(control: PageControl, gateway: str) -> None:
    program = EXAMPLES / "voice-assistant" / "assistant.py"
    with start_python(program, gateway) as assistant:
        assert assistant.stdin is not None
        assert assistant.stdout is not None

        def type_line(text: str) -> None:
            print(text, file=assistant.stdin, flush=True)

        session = assistant.stdout.readline().split()[-1]
        type_line(LONG_QUESTION)
        wait_until(lambda: control.samples(session).any())
        assert not control.messages_of(FlushSession)
        type_line("no")
        wait_until(lambda: control.sessions_of(FlushSession) == [session])
        output, log = assistant.communicate(timeout=LIMIT_S)
    assert assistant.returncode == 0, log
    assert output.split("\n")[:3] == ["answer 1", "interrupted", "answer 2"]
    assert control.has_ended(session)
    spoken_s = len(control.samples(session)) / 16000
    assert spoken_s < 0.2 * len(f"you said {LONG_QUESTION}")


def test_the_avatar_shows_the_face_of_a_session(
    control: PageControl, gateway: str, site: str, tmp_path: Path
) -> None:
    browser = Browser(tmp_path, DEMO / "hello-female.wav", size_px=(240, 180))
    try:
        address, _, token = gateway.partition("?")
        browser.command("Page.navigate", url=f"{site}/index.html?gateway={address}&{token}")
        browser.wait_for("window.avatar !== undefined")
        rest = browser.image()
        with Client(control.address, insecure=True) as client, client.open_session("seen"):
            shown = ARKIT.faps(np.eye(52, dtype=np.float32)[ARKIT.names.index("jawOpen")])
            control.talk("seen", shown, "a")
            browser.wait_for("avatar.vrm.expressionManager.getValue('jawOpen') > 0.9")
            browser.wait_for("document.getElementById('note').textContent === 'seen'")

            def is_open() -> bool:
                moved = np.abs(browser.image().astype(int) - rest).max(axis=2)
                return bool((moved[70:150, 90:150] > 60).sum() > 40)

            wait_until(is_open)
        browser.command("Page.navigate", url=f"{site}/index.html?gateway=127.0.0.1:8080")
        note = "document.getElementById('note')?.textContent"
        browser.wait_for(f"{note}?.startsWith('127.0.0.1:8080 is not the address of a gateway')")
        assert [text for text in browser.page_errors if "exceptionDetails" in text] == []
    finally:
        browser.close()
