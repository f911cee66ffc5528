"""Access to the gateway over HTTP: paths, host names, origins, tokens and certificates."""

import contextlib
import json
import re
import socket
import ssl
import stat
import subprocess
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse, HTTPSConnection
from pathlib import Path

import pytest

from tests.system import (
    LIMIT_S,
    SERVICE,
    Gateway,
    System,
    free_port,
    port_of,
    start_python,
    wait_until,
)

NO_CONTROL = "tcp://127.0.0.1:9"
UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


class HttpGateway:
    """A gateway that is asked over http, or over https with a certificate."""

    def __init__(self, certificate: Path | None = None, **settings: str) -> None:
        if certificate is not None:
            settings["https"] = str(certificate)
        self.certificate = certificate
        self.gateway = Gateway(NO_CONTROL, insecure="false", **settings)
        wait_until(lambda: certificate is None or certificate.is_file())

    def ask(
        self, path: str, method: str = "GET", body: str | None = None, **headers: str
    ) -> HTTPResponse:
        """Return the head of an answer."""
        port = port_of(self.gateway.page)
        if self.certificate is None:
            connection = HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
        else:
            tls = ssl.create_default_context(cafile=self.certificate)  # also checks the names
            connection = HTTPSConnection("127.0.0.1", port, timeout=LIMIT_S, context=tls)
        with contextlib.closing(connection):
            connection.request(method, f"/{path}", body, headers)
            return connection.getresponse()


@pytest.fixture(scope="module")
def local_gateway() -> Iterator[HttpGateway]:
    """A gateway on loopback without a token."""
    site = HttpGateway()
    yield site
    assert site.gateway.stop() == 0


@pytest.fixture(scope="module")
def public_gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpGateway]:
    """A gateway on all addresses, with https and a token."""
    site = HttpGateway(
        tmp_path_factory.mktemp("https") / "kouxing.pem",
        host="0.0.0.0",  # noqa: S104 - with https and a token
        token="secret",
        names="face.example",
        trusted_origins="https://tool.example https://other.example:8443",
        senders=f"vmc://192.0.2.7 vts://127.0.0.1:{free_port()}",
    )
    yield site
    assert site.gateway.stop() == 0


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("viewer", {"Origin": "http://evil.example", **UPGRADE}, 403),
        ("microphone", {"Origin": "null", **UPGRADE}, 403),
        ("", {"Host": "evil.example"}, 403),
        ("viewer?session=..%2F", UPGRADE, 400),
        ("viewer?shapes=face", UPGRADE, 400),
        ("viewer?shapes=vrm&format=xml", UPGRADE, 400),
        ("..%2Fservice.py", {}, 404),
        ("package.json", {}, 404),
        ("modules/three/build/..%2Fpackage.json", {}, 404),
        ("modules/face_mesh/package.json", {}, 404),
        ("modules/face_mesh/..%2F..%2Fthree%2Fpackage.json", {}, 404),
    ],
)
def test_rejects_foreign_pages_and_other_files(
    local_gateway: HttpGateway, path: str, headers: dict[str, str], status: int
) -> None:
    assert local_gateway.ask(path, **headers).status == status


def test_the_policies_allow_functions_from_text_only_to_the_face_mesh(
    local_gateway: HttpGateway,
) -> None:
    page = local_gateway.ask("").headers["Content-Security-Policy"]
    assert "default-src 'self'" in page
    assert "unsafe" not in page
    frame = local_gateway.ask("face-mesh.html").headers
    assert "script-src 'self' 'unsafe-eval'" in frame["Content-Security-Policy"]
    assert "frame-ancestors 'self'" in frame["Content-Security-Policy"]
    assert frame["Permissions-Policy"] == "camera=(), microphone=()"


@pytest.mark.parametrize(
    ("name", "content_type"),
    [
        ("face_mesh/face_mesh.js", "javascript"),
        ("face_mesh/face_mesh.binarypb", "application/octet-stream"),
        ("face_mesh/face_mesh_solution_simd_wasm_bin.wasm", "application/wasm"),
        ("three/build/three.module.js", "javascript"),
    ],
)
def test_serves_the_modules_of_the_page(
    local_gateway: HttpGateway, name: str, content_type: str
) -> None:
    answer = local_gateway.ask(f"modules/{name}")
    assert answer.status == 200
    assert answer.headers["Content-Type"].partition(";")[0].endswith(content_type)
    assert answer.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    "path", ["viewer", "microphone", "whip", "learn-mouth", "sound", "senders"]
)
def test_sessions_and_uploads_require_the_token(public_gateway: HttpGateway, path: str) -> None:
    for query in ("", "?token=wrong"):
        assert public_gateway.ask(path + query, **UPGRADE).status == 403


def test_the_token_opens_sessions_and_the_page_requires_none(public_gateway: HttpGateway) -> None:
    for origin in ({}, {"Origin": "https://tool.example"}):
        assert public_gateway.ask("viewer?token=secret", **origin, **UPGRADE).status == 101
    page = public_gateway.ask("")
    assert page.status == 200
    ancestors = "frame-ancestors https://tool.example https://other.example:8443"
    assert page.headers["Content-Security-Policy"].endswith(ancestors)


def test_whip_accepts_bearer_tokens_from_trusted_origins(public_gateway: HttpGateway) -> None:
    preflight = public_gateway.ask("whip", "OPTIONS", Origin="https://tool.example")
    assert preflight.status == 204
    assert "Authorization" in preflight.headers["Access-Control-Allow-Headers"]
    assert public_gateway.ask("whip", "OPTIONS", Origin="https://evil.example").status == 403
    for token, status in (("wrong", 403), ("secret", 404)):
        headers = {"Origin": "https://tool.example", "Authorization": f"Bearer {token}"}
        answer = public_gateway.ask("whip/unknown", "DELETE", **headers)
        assert answer.status == status
        # Without these headers, the browser hides the answer from the page.
        assert answer.headers["Access-Control-Allow-Origin"] == "https://tool.example"
        assert "Retry-After" in answer.headers["Access-Control-Expose-Headers"]


@pytest.mark.parametrize(
    ("url", "headers", "status"),
    [
        ("vmc://192.0.2.7", {}, 200),  # in the configuration
        ("VMC://192.0.2.7:39540/", {}, 200),
        ("vmc://192.0.2.7:39539", {}, 422),
        ("vmc://evil.example", {}, 422),
        ("vmc://127.0.0.1:39539", {"Origin": "https://evil.example"}, 403),
    ],
)
def test_a_page_sends_only_to_this_machine_and_to_configured_addresses(
    public_gateway: HttpGateway, url: str, headers: dict[str, str], status: int
) -> None:
    body = json.dumps({"start": url})
    assert public_gateway.ask("senders?token=secret", "POST", body, **headers).status == status


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.example", 403),  # DNS rebinding
        ("face.example", 200),
        (f"{socket.gethostname()}:8080", 200),
        ("192.0.2.7:8080", 200),
        ("localhost", 200),
    ],
)
def test_answers_only_under_its_own_names(
    public_gateway: HttpGateway, host: str, status: int
) -> None:
    page = public_gateway.ask("", Host=host)
    assert page.status == status
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert page.headers["Referrer-Policy"] == "no-referrer"
    assert page.headers["Cross-Origin-Opener-Policy"] == "same-origin"
    assert "Set-Cookie" not in page.headers


def test_only_the_owner_can_read_the_certificate(public_gateway: HttpGateway) -> None:
    assert public_gateway.ask("").status == 200
    assert public_gateway.certificate is not None
    assert stat.S_IMODE(public_gateway.certificate.stat().st_mode) == 0o600


def gateway_process(control: str = NO_CONTROL, **settings: str) -> subprocess.Popen[str]:
    names = {f"KOUXING_{name.upper()}": value for name, value in settings.items()}
    names = {"KOUXING_GATEWAY_PORT": "0", **names}
    return start_python(*SERVICE, "gateway", control=control, **names)


def test_http_for_a_proxy_creates_and_prints_a_token(tmp_path: Path) -> None:
    settings = {
        "gateway_host": "0.0.0.0",  # noqa: S104
        "gateway_https": "proxy",
        "advertise": "127.0.0.1",
    }
    with contextlib.ExitStack() as stack:
        system = stack.enter_context(System(["control"], tmp_path))
        process = stack.enter_context(gateway_process(system.control, **settings))
        stack.callback(process.terminate)
        assert process.stderr is not None
        matches = (
            re.search(r"page=http://127.0.0.1:(\d+)/#token=([\w-]{22})", line)
            for line in process.stderr
        )
        port, token = next(filter(None, matches)).groups()
        for query, status in (("", 403), (f"?token={token}", 101)):
            connection = HTTPConnection("127.0.0.1", int(port), timeout=LIMIT_S)
            with contextlib.closing(connection) as http:
                http.request("GET", f"/viewer{query}", headers=UPGRADE)
                assert http.getresponse().status == status


@pytest.mark.parametrize(
    ("certificate", "text"),
    [(__file__, "gateway.https: "), ("/no/such/folder/new.pem", "No such file or directory")],
)
def test_a_wrong_certificate_ends_the_gateway_with_a_message(certificate: str, text: str) -> None:
    process = gateway_process(gateway_https=certificate)
    _, log = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 2
    assert text in log
