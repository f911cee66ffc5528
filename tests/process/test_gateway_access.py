"""Who may reach the gateway: https with a token, other pages, frames."""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import ssl
import stat
import subprocess
import sys
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from kouxing.evaluation.system.chromium import wait_until
from tests.scripted_system import Gateway
from tests.system import ROOT, free_port

pytestmark = pytest.mark.process

NO_CONTROL = "tcp://127.0.0.1:9"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("https") / "kouxing.pem"


@pytest.fixture(scope="module")
def gateway(certificate: Path) -> Iterator[Gateway]:
    gateway = Gateway(
        NO_CONTROL,
        free_port(),
        host="0.0.0.0",  # noqa: S104 - with https and a token
        certificate=str(certificate),
        token="secret",
        names="face.example",
        allowed_origins="https://tool.example",
        frame_ancestors="https://tool.example https://other.example:8443",
        senders=f"vmc://192.0.2.7 vts://127.0.0.1:{free_port()}",
    )
    wait_until(lambda: certificate.is_file() and certificate.read_bytes(), 60)
    yield gateway
    assert gateway.stop() == 0


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


def get(gateway: Gateway, certificate: Path, path: str, headers: dict[str, str]) -> HTTPResponse:
    return ask(gateway, certificate, "GET", path, headers)


def ask(
    gateway: Gateway,
    certificate: Path,
    method: str,
    path: str,
    headers: dict[str, str],
    body: str | None = None,
) -> HTTPResponse:
    """Return the head of an answer."""
    tls = ssl.create_default_context(cafile=certificate)  # names are checked, too
    with contextlib.closing(
        HTTPSConnection("127.0.0.1", urlsplit(gateway.page).port, timeout=60, context=tls)
    ) as connection:
        wait_until(lambda: can_connect(connection), 60)
        connection.request(method, f"/{path}", body, headers)
        return connection.getresponse()


def can_connect(connection: HTTPSConnection) -> bool:
    try:
        connection.connect()
    except ConnectionRefusedError:
        return False
    return True


@pytest.mark.parametrize("path", ["viewer", "microphone", "whip", "learn-mouth", "senders"])
def test_sessions_need_the_token(gateway: Gateway, certificate: Path, path: str) -> None:
    for query in ("", "?token=wrong"):
        assert get(gateway, certificate, path + query, UPGRADE).status == 403


def test_the_token_opens_and_the_page_itself_needs_none(
    gateway: Gateway, certificate: Path
) -> None:
    assert get(gateway, certificate, "viewer?token=secret", UPGRADE).status == 101
    page = get(gateway, certificate, "", {})
    assert page.status == 200
    ancestors = "frame-ancestors https://tool.example https://other.example:8443"
    assert page.headers["Content-Security-Policy"].endswith(ancestors)


def test_whip_takes_the_token_as_its_clients_send_it_and_answers_pages_that_may_connect(
    gateway: Gateway, certificate: Path
) -> None:
    headers = {"Origin": "https://tool.example"}
    asked = ask(gateway, certificate, "OPTIONS", "whip", headers)
    assert asked.status == 204
    assert "Authorization" in asked.headers["Access-Control-Allow-Headers"]
    evil = ask(gateway, certificate, "OPTIONS", "whip", {"Origin": "https://evil.example"})
    assert evil.status == 403
    for token, status in (("wrong", 403), ("secret", 404)):
        given = {**headers, "Authorization": f"Bearer {token}"}
        ended = ask(gateway, certificate, "DELETE", "whip/unknown", given)
        assert ended.status == status


@pytest.mark.parametrize(
    ("origin", "status"), [("https://tool.example", 101), ("https://evil.example", 403)]
)
def test_only_pages_that_are_named_may_connect(
    gateway: Gateway, certificate: Path, origin: str, status: int
) -> None:
    headers = {**UPGRADE, "Origin": origin}
    assert get(gateway, certificate, "viewer?token=secret", headers).status == status


@pytest.mark.parametrize(
    ("url", "origin", "status"),
    [
        ("vmc://192.0.2.7", None, 200),  # of the configuration
        ("vmc://192.0.2.7:39539", None, 422),
        ("vmc://evil.example", None, 422),
        ("vmc://127.0.0.1:39539", "https://evil.example", 403),
    ],
)
def test_a_page_sends_to_this_machine_and_to_what_is_configured(
    gateway: Gateway, certificate: Path, url: str, origin: str | None, status: int
) -> None:
    headers = {"Origin": origin} if origin else {}
    body = json.dumps({"start": url})
    assert ask(gateway, certificate, "POST", "senders?token=secret", headers, body).status == status


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.example", 403),  # resolves to this machine: DNS rebinding
        ("face.example", 200),
        (f"{socket.gethostname()}:8080", 200),
        ("192.0.2.7:8080", 200),
        ("localhost", 200),
    ],
)
def test_only_its_own_names_are_answered(
    gateway: Gateway, certificate: Path, host: str, status: int
) -> None:
    page = get(gateway, certificate, "", {"Host": host})
    assert page.status == status
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert page.headers["Referrer-Policy"] == "no-referrer"
    assert page.headers["Cross-Origin-Opener-Policy"] == "same-origin"
    assert "Set-Cookie" not in page.headers


def test_the_made_certificate_is_for_its_owner_alone(gateway: Gateway, certificate: Path) -> None:
    assert stat.S_IMODE(certificate.stat().st_mode) == 0o600


def test_plain_http_to_a_proxy_needs_a_token_too_which_is_made_and_shown() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "kouxing.services.gateway"],
        cwd=ROOT,
        env={
            **os.environ,
            "KOUXING_CONTROL": NO_CONTROL,
            "KOUXING_GATEWAY_HOST": "0.0.0.0",  # noqa: S104
            "KOUXING_GATEWAY_PORT": "0",
            "KOUXING_GATEWAY_PLAIN_HTTP": "true",
            "KOUXING_ADVERTISE": "127.0.0.1",
        },
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        shown = (re.search(r"page=http://127.0.0.1:(\d+)/#token=([\w-]{22})", line)
                 for line in process.stderr)  # fmt: skip
        port, token = next(filter(None, shown)).groups()
        for query, status in (("", 403), (f"?token={token}", 101)):
            with contextlib.closing(HTTPConnection("127.0.0.1", int(port), timeout=60)) as http:
                http.request("GET", f"/viewer{query}", headers=UPGRADE)
                assert http.getresponse().status == status
    finally:
        process.terminate()
        process.communicate(timeout=60)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"HOST": "0.0.0.0"}, "gateway.certificate=kouxing.pem"),  # noqa: S104
        ({"CERTIFICATE": __file__}, "gateway.certificate: "),
        ({"CERTIFICATE": "/no/such/folder/new.pem"}, "No such file or directory"),
        (
            {"SENDERS": "vmc://127.0.0.1 http://127.0.0.1"},
            "a list of addresses such as vmc://127.0.0.1:39540",
        ),
        ({"FRAME_ANCESTORS": "https://a.example; script-src *"}, "a list of origins"),
    ],
)
def test_what_is_wrong_is_named(settings: dict[str, str], named: str) -> None:
    result = subprocess.run(
        [sys.executable, "-m", "kouxing.services.gateway"],
        cwd=ROOT,
        env={
            **os.environ,
            "KOUXING_GATEWAY_PORT": "0",
            **{f"KOUXING_GATEWAY_{key}": value for key, value in settings.items()},
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 2
    assert named in result.stderr
