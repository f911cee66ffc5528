"""A page of another origin cannot send messages to a service, only meaningless bytes."""

from __future__ import annotations

import base64
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import Heartbeat
from tests.browser import Browser
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e

FORGED = Heartbeat(service="lamp", instance="forged", role="observer", state="ready", sent_ns=0)


class Page(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the library's name
        pass


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("browser"), DEMO / "hello-female.wav")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser.command("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/")
    browser.wait_for("location.protocol === 'http:' && document.readyState === 'complete'")
    yield browser
    browser.close()
    server.shutdown()
    server.server_close()


def zmtp1_frame(body: bytes, *, more: bool) -> bytes:
    length = 1 + len(body)
    head = bytes([length]) if length < 255 else b"\xff" + length.to_bytes(8, "big")
    return head + bytes([more]) + body


def hidden(parts: list[bytes], shift: int) -> bytes:
    """Return the body of a request that ZMTP 1 can read as a message.

    ZMTP 1 reads the request line, the headers and the filler as frames. Every 1 in the filler is
    either the length or the flags of an empty frame. ``shift`` (0 or 1) covers both cases.
    """
    frames = [zmtp1_frame(part, more=part is not parts[-1]) for part in parts]
    return b"\x01" * (600 + shift) + b"\x01\x00" + b"".join(frames)


@pytest.mark.parametrize("insecure", [False, True])
def test_a_page_of_another_origin_cannot_forge_a_message(
    browser: Browser, tmp_path: Path, insecure: bool
) -> None:
    with System(("control",), tmp_path, insecure=insecure) as system:
        port = int(system.environment["KOUXING_CONTROL"].rpartition(":")[2])
        for shift in (0, 1):
            body = base64.b64encode(hidden(encode(FORGED), shift)).decode()
            browser.evaluate(
                f"fetch('http://127.0.0.1:{port}/', {{method: 'POST', mode: 'no-cors',"
                f" body: Uint8Array.from(atob('{body}'), c => c.charCodeAt(0)),"
                " signal: AbortSignal.timeout(1000)}).catch(() => {})"
            )
        with system.client() as client:
            known = {service.instance for service in client.status().services}
    assert known
    assert "forged" not in known
