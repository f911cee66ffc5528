"""Access to bound sockets: keys, roles, revoked keys and old clients."""

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import pytest
from kouxing_client.keys import Key
from kouxing_client.messages import FapFrame, Joined, Message

from kouxing.services.service_kinds import KINDS
from kouxing.shared.errors import UserError
from kouxing.shared.network.bus import Bus, ProbeResult
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.base import Service
from kouxing.shared.settings.config import ServiceConfig
from kouxing.shared.settings.endpoints import split_endpoint, with_key
from kouxing.shared.settings.keys import key_folder, load_key
from kouxing.shared.wire.codec import encode
from kouxing.shared.wire.control import AllowedKey
from kouxing.shared.wire.session import StatusRequest
from tests.system import LIMIT_S, wait_until

LOCAL = "tcp://127.0.0.1:*"
pytestmark = pytest.mark.usefixtures("new_keys")


class Server:
    """Sockets that are bound with control's key."""

    def __init__(self) -> None:
        self.key = load_key("control", ())
        self.bus = Bus(self.key)

    def router(self, name: str, role: str = "") -> tuple[Socket, str]:
        router = self.bus.bind_router(LOCAL, name, role=role)
        return router, with_key(router.endpoint, self.key.public)

    def publisher(self) -> tuple[Socket, str]:
        publisher = self.bus.bind_publisher(LOCAL, "synthesizer.faps")
        return publisher, with_key(publisher.endpoint, self.key.public)


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.bus.close()


def hide_in_request(message: Message, shift: int) -> bytes:
    """Return a browser's request whose body ZMTP 1 can read as a message.

    ZMTP 1 reads the request line, the headers and the filler as frames. Every 1 in the filler is
    either the length or the flags of an empty frame. ``shift`` (0 or 1) covers both cases.
    """
    frames = b""
    parts = encode(message)
    for part in parts:
        length = 1 + len(part)
        head = bytes([length]) if length < 255 else b"\xff" + length.to_bytes(8, "big")
        frames += head + bytes([part is not parts[-1]]) + part
    head = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://evil.example\r\n\r\n"
    return head + b"\x01" * (600 + shift) + b"\x01\x00" + frames


def assert_receives_only(router: Socket, endpoint: str, key: Key | None) -> None:
    """Check that the message of an accepted key is the only message that arrives."""
    with Bus(key) as bus:
        bus.connect_dealer(endpoint).send(StatusRequest(request="only"))
        assert router.wait(LIMIT_S)
        (received,) = router.receive()
    assert isinstance(received.message, StatusRequest)
    assert received.message.request == "only"
    assert received.sender.key == (key.public if key else "")


@pytest.mark.parametrize(
    ("required", "accepted", "rejected"),
    [
        ("client", ("client",), ("subscriber:*", "service:driver")),
        ("service", ("service:recognizer",), ("client", "operator")),
    ],
)
def test_a_socket_accepts_only_keys_of_its_role(
    server: Server, required: str, accepted: tuple[str, ...], rejected: tuple[str, ...]
) -> None:
    router, endpoint = server.router("some.setting", role=required)
    with Bus(load_key("rejected", rejected)) as bus:
        bus.connect_dealer(endpoint).send(StatusRequest(request="1"))
        assert bus.probe(endpoint) is ProbeResult.REJECTED
        assert_receives_only(router, endpoint, load_key("accepted", accepted))


def test_rejects_a_key_of_another_system(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    router, endpoint = server.router("control.commands")
    with monkeypatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
        key, control = load_key("grant", ("client",)), load_key("control", ())
    with Bus(key) as bus:
        bus.connect_dealer(endpoint).send(StatusRequest(request="1"))
        assert bus.probe(endpoint) is ProbeResult.REJECTED
        assert bus.probe(with_key(router.endpoint, control.public)) is ProbeResult.REJECTED
        assert_receives_only(router, endpoint, load_key("screen", ("subscriber:*",)))


@pytest.mark.parametrize("with_keys", [True, False])
@pytest.mark.parametrize(
    "greeting",
    [
        b"\x01\x00" + b"\x03\x00hi",  # ZMTP 1
        b"\xff" + bytes(8) + b"\x7f\x01\x05\x00\x00",  # ZMTP 2
        hide_in_request(StatusRequest(request="1"), 0),
        hide_in_request(StatusRequest(request="1"), 1),
    ],
)
def test_disconnects_old_zeromq_and_browsers(greeting: bytes, with_keys: bool) -> None:
    key = load_key("control", ()) if with_keys else None
    with Bus(key) as bus:
        router = bus.bind_router(LOCAL, "control.commands")
        _, port = split_endpoint(router.endpoint, "")
        with socket.create_connection(("127.0.0.1", int(port)), timeout=LIMIT_S) as browser:
            browser.sendall(greeting + bytes(64))
            try:
                while browser.recv(1000):
                    pass
            except ConnectionResetError:
                pass
        endpoint = with_key(router.endpoint, key.public if key else "")
        assert_receives_only(router, endpoint, load_key("client", ()) if with_keys else None)


def test_a_subscriber_receives_only_the_sessions_of_its_role(server: Server) -> None:
    publisher, endpoint = server.publisher()
    with Bus(load_key("screen", ("subscriber:mine",))) as bus:
        subscriber = bus.connect_subscriber(endpoint)
        for session in (None, "theirs"):
            subscriber.subscribe(FapFrame, session)
        subscriber.subscribe(FapFrame, "mine")
        subscriber.subscribe(Joined, "mine")
        received: list[tuple[type, str]] = []

        def exchange() -> None:
            publisher.wait(0.01)
            list(publisher.receive())
            messages = [cast(Message, item.message) for item in subscriber.receive()]
            received.extend((type(message), message.session) for message in messages)

        wait_until(lambda: received, step=exchange)  # then the subscriptions are in effect
        for session in ("theirs", "mine"):
            publisher.send(FapFrame(session=session, packed_values=bytes(272), mask=bytes(9)))
        wait_until(lambda: len(received) > 1, step=exchange)
        assert received == [(Joined, "mine"), (FapFrame, "mine")]


class KeyOnlyService(Service):
    """A service that only decides which keys may connect."""

    kind = KINDS["recognizer"]


def test_uses_a_list_that_cannot_be_written_until_the_service_ends(
    server: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    key = load_key("laptop", ("client",))
    load_key("recognizer", ("service:recognizer",))
    shutil.copytree(key_folder(), tmp_path / "other" / "kouxing")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
    for name in ("control.key", "allowed"):  # as on another machine, whose list is empty yet
        (key_folder() / name).unlink()
    service = KeyOnlyService(ServiceConfig())
    with service.bus, Bus(key) as bus:
        router = service.bus.bind_router(LOCAL, "recognizer.audio")
        endpoint = with_key(router.endpoint, service.key.public if service.key else "")
        assert bus.probe(endpoint) is ProbeResult.REJECTED
        key_folder().chmod(0o755)  # nothing is written there
        allowed = {key.public: AllowedKey(name="laptop", roles=["client"])}
        service._allow_keys(allowed)
        assert "until this process ends: other users can read" in caplog.text
        assert bus.probe(endpoint) is not ProbeResult.REJECTED
        service._allow_keys({})
        assert bus.probe(endpoint) is ProbeResult.REJECTED


@pytest.mark.parametrize(
    ("endpoint", "is_plain", "error_text"),
    [
        ("tcp://127.0.0.1:1", False, "tcp://127.0.0.1:1 uses no encryption, but this program does"),
        (
            "tcp://127.0.0.1:1 " + "a" * 40,
            True,
            "tcp://127.0.0.1:1 uses encryption, but this program does not",
        ),
        ("tcp://-:1", True, "is not an endpoint"),
        ("tcp://127.0.0.1:0 short", False, "cannot connect"),
        ("udp://127.0.0.1:1", True, "is not an endpoint"),
    ],
)
def test_rejects_an_endpoint_that_cannot_be_connected_to(
    server: Server, endpoint: str, is_plain: bool, error_text: str
) -> None:
    with Bus(None if is_plain else server.key) as bus, pytest.raises(UserError, match=error_text):
        bus.connect_dealer(endpoint)
