"""Examples that use the gateway: the voice assistant and the avatar in a browser."""

from __future__ import annotations

import functools
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client

from kouxing.evaluation.system.chromium import wait_until
from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.face.shapes import ARKIT
from tests import heads
from tests.browser import Browser
from tests.scripted_system import Gateway, System
from tests.system import ROOT, free_port

EXAMPLES = ROOT / "examples"

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def system() -> Iterator[System]:
    system = System()
    yield system
    system.close()


class Site(ThreadingHTTPServer):
    """Serves a folder like `python -m http.server`."""

    def __init__(self, folder: Path) -> None:
        class Handler(SimpleHTTPRequestHandler):
            def log_message(self, *_: object) -> None:
                pass

        super().__init__(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
        self.origin = f"http://127.0.0.1:{self.server_port}"
        threading.Thread(target=self.serve_forever).start()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """The example's page with an avatar."""
    folder = tmp_path_factory.mktemp("site")
    for file in (EXAMPLES / "browser-vrm").iterdir():
        (folder / file.name).symlink_to(file)
    export_glb(heads.load("woman", "coarse"), folder / "avatar.vrm")
    with Site(folder) as site:
        yield site
        site.shutdown()


@pytest.fixture(scope="module")
def gateway(system: System, site: Site) -> Iterator[str]:
    """The gateway's address."""
    gateway = Gateway(system.address, free_port(), allowed_origins=site.origin)
    with Client(system.address) as client:
        wait_until(lambda: len(client.status().services) == 4, 60)
    yield gateway.page.replace("http", "ws")
    assert gateway.stop() == 0


def test_the_assistant_can_be_interrupted(system: System, gateway: str) -> None:
    recognizer = system.recognizer
    assert recognizer is not None
    program = [sys.executable, str(EXAMPLES / "voice-assistant" / "assistant.py"), gateway]
    with subprocess.Popen(
        program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as assistant:
        assert assistant.stdin is not None
        assert assistant.stdout is not None
        session = assistant.stdout.readline().split()[-1]
        assistant.stdin.write("a very long question\n")
        wait_until(lambda: any(recognizer.pcm.get(session, b"")), 30)
        assert not recognizer.flushed
        assistant.stdin.write("no\n")
        wait_until(lambda: recognizer.flushed == [session], 30)
        assistant.stdin.close()
        output = assistant.stdout.read().split("\n")
        assert assistant.wait(60) == 0
    assert output[:3] == ["answer 1", "interrupted", "answer 2"]
    assert session in recognizer.finished
    spoken_s = len(recognizer.pcm[session]) / 2 / 16000
    assert spoken_s < 0.2 * len("you said a very long question") + 0.2 * len("you said no")


def test_the_avatar_shows_the_face_of_a_session(
    system: System, gateway: str, site: Site, tmp_path: Path
) -> None:
    browser = Browser(tmp_path, ROOT / "shared" / "demo" / "hello-female.wav")
    browser.resize(240, 180)  # the processor draws
    try:
        browser.command("Page.navigate", url=f"{site.origin}/index.html?gateway={gateway}")
        browser.wait_for("window.avatar !== undefined")
        rest = browser.image()
        with Client(system.address) as client:
            session = client.open_session(name="seen")
            shown = ARKIT.faps(np.eye(52, dtype=np.float32)[ARKIT.names.index("jawOpen")])
            system.talk("seen", shown, "a")
            browser.wait_for("avatar.vrm.expressionManager.getValue('jawOpen') > 0.9")
            browser.wait_for("document.getElementById('note').textContent === 'seen'")

            def is_open() -> bool:
                moved = np.abs(browser.image().astype(int) - rest).max(axis=2)
                return bool((moved[70:150, 90:150] > 60).sum() > 40)

            wait_until(is_open, 60)
            system.shown = None
            session.close()
        assert [text for text in browser.complaints if "exceptionDetails" in text] == []
    finally:
        browser.close()
