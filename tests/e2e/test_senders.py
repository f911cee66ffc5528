"""SenderPool over real sockets: receivers that are missing, return, are delayed, or deny access."""

import asyncio
import contextlib
import errno
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from aiohttp import web
from pythonosc.osc_bundle import OscBundle

from kouxing.services.gateway.senders_api import SendersApi
from kouxing.services.senders import connection, vtube_studio
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.live_link import LiveLinkConnection
from kouxing.services.senders.protocols import make_connection, parse_target
from kouxing.services.senders.sender_pool import MAX_SENDERS, SenderPool
from kouxing.services.senders.vmc import VmcConnection
from kouxing.services.senders.vtube_studio import VTubeStudioConnection
from kouxing.shared.errors import UserError
from kouxing.shared.face.idle_motion import STALL_S
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.receivers import LIVE_LINK_ORDER, frame_of, read_live_link
from tests.system import LIMIT_S, free_port, free_udp_port, wait_until
from tests.vtube_studio import VTubeStudioStub

OPEN_MOUTH = frame_of("vrm", aa=1.0).faps


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Use a separate folder of tokens, and short pauses between connection attempts."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for module in (connection, vtube_studio):
        monkeypatch.setattr(module, "RETRY_S", 0.05)


@pytest.fixture
def reports() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def senders(reports: list[tuple[str, str]]) -> Iterator[SenderPool]:
    with contextlib.closing(
        SenderPool(lambda *report: reports.append(report), idle_motion=False)
    ) as new_senders:
        yield new_senders


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp_socket:
        udp_socket.bind(("127.0.0.1", 0))
        udp_socket.settimeout(LIMIT_S)
        yield udp_socket


def problem_of(senders: SenderPool, url: str) -> str:
    return next(state.problem for state in senders.states() if state.target == url)


def test_reports_a_missing_receiver_and_finds_it_later(
    senders: SenderPool, receiver: socket.socket, reports: list[tuple[str, str]]
) -> None:
    port = free_udp_port()
    missing = f"osc://127.0.0.1:{port}"
    receiver_url = f"osc://127.0.0.1:{receiver.getsockname()[1]}"
    senders.start(parse_target(missing))
    senders.start(parse_target(receiver_url))
    wait_until(lambda: "no program is listening" in problem_of(senders, missing))
    assert receiver.recv(2000)  # other targets are not affected
    assert problem_of(senders, receiver_url) == ""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", port))
        wait_until(lambda: not problem_of(senders, missing))
        late.settimeout(LIMIT_S)
        assert late.recv(2000)
    wait_until(lambda: len(reports) >= 2)
    assert [url for url, _ in reports[:2]] == [missing, missing]
    assert (bool(reports[0][1]), reports[1][1]) == (True, "")


def test_an_unknown_host_does_not_delay_other_targets(
    senders: SenderPool, receiver: socket.socket
) -> None:
    lost = "vmc://nowhere.invalid"
    senders.start(parse_target(lost))
    senders.start(parse_target(f"livelink://127.0.0.1:{receiver.getsockname()[1]}"))
    assert receiver.recv(2000)
    wait_until(lambda: "cannot reach nowhere.invalid" in problem_of(senders, lost))


def test_a_firewall_is_reported_without_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    osc = make_connection(parse_target("osc://127.0.0.1:9000"))
    send, refused = socket.socket.send, list[bytes]()

    def refuse(sender: socket.socket, data: bytes) -> int:
        if sender.type != socket.SOCK_DGRAM:
            return send(sender, data)
        refused.append(data)
        raise PermissionError(errno.EPERM, "Operation not permitted")

    async def collect_problems() -> set[str]:
        problems = set()
        connecting = asyncio.create_task(osc.run())
        async with asyncio.timeout(LIMIT_S):
            while len(refused) < 5:  # the socket was opened 5 times
                if refused:
                    problems.add(osc.problem)
                osc.send(FaceFrame(OPEN_MOUTH, 0.0))
                await asyncio.sleep(0.01)
        connecting.cancel()
        return problems

    monkeypatch.setattr(socket.socket, "send", refuse)
    (problem,) = asyncio.run(collect_problems())
    assert problem.startswith("cannot reach 127.0.0.1:9000: Operation not permitted")


def test_an_error_of_a_protocol_does_not_affect_other_targets(
    senders: SenderPool, receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    faulty = "vmc://127.0.0.1"
    monkeypatch.setattr(VmcConnection, "send", mock.Mock(side_effect=ValueError("no")))
    senders.start(parse_target(faulty))
    senders.start(parse_target(f"livelink://127.0.0.1:{receiver.getsockname()[1]}"))
    assert receiver.recv(2000)
    assert problem_of(senders, faulty) == "cannot send a frame: ValueError('no')"


def test_an_error_that_ends_a_connection_is_reported(
    senders: SenderPool, monkeypatch: pytest.MonkeyPatch, reports: list[tuple[str, str]]
) -> None:
    monkeypatch.setattr(VmcConnection, "run", mock.AsyncMock(side_effect=ValueError("no")))
    senders.start(parse_target("vmc://"))
    wait_until(lambda: "the connection ended: ValueError('no')" in str(reports))


def test_a_broadcast_address_reaches_all_machines_of_a_network(senders: SenderPool) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("", 0))
        receiver.settimeout(LIMIT_S)
        senders.start(parse_target(f"osc://127.255.255.255:{receiver.getsockname()[1]}"))
        assert receiver.recv(4096).startswith(b"#bundle")


@pytest.mark.parametrize("address", ["127.0.0.1", "127.255.255.255"])
def test_a_tracker_must_not_receive_what_it_sends(
    senders: SenderPool, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    resolve = socket.getaddrinfo
    monkeypatch.setattr(socket, "getaddrinfo", lambda _, *args: resolve(address, *args))
    port = free_udp_port()
    url = f"vmc://pc.local:{port}?camera=0.0.0.0:{port}"
    senders.start(parse_target(url))
    wait_until(lambda: "is the port of the avatar program itself" in problem_of(senders, url))


def test_starts_and_stops_senders(senders: SenderPool, receiver: socket.socket) -> None:
    url = f"livelink://localhost:{receiver.getsockname()[1]}"
    senders.start(parse_target(url))
    senders.start(parse_target(url))  # ignored
    assert receiver.recv(2000)
    wait_until(lambda: senders.states()[0].rate_hz > 0)
    (state,) = senders.states()
    target = parse_target(url)
    assert (state.target, state.contents) == (target.url, "ARKit shapes and head")
    senders.stop(target)
    senders.stop(target)
    assert senders.states() == []
    for number in range(MAX_SENDERS):
        senders.start(parse_target(f"osc://127.0.0.1:{9 + number}"))
    with pytest.raises(UserError, match="stop one first"):
        senders.start(parse_target(url))


def test_a_page_starts_trackers_on_this_machine_only() -> None:
    api = SendersApi([], lambda: None, idle_motion=False)
    request = mock.AsyncMock()
    request.read.return_value = b'{"start": "vmc://?camera=0.0.0.0:39541"}'
    with contextlib.closing(api.pool):
        answer = asyncio.run(api.serve_post(request))
        assert not api.pool.is_sending
    assert isinstance(answer, web.Response)
    assert answer.status == 422
    assert "camera=0.0.0.0:39541 accepts data from other machines" in (answer.text or "")


def test_a_new_delay_is_part_of_the_addresses(senders: SenderPool) -> None:
    url = "osc://127.0.0.1:9?delay=120&only=mouth&prefix=/a"

    def shown() -> tuple[str, float]:
        (state,) = senders.states()
        return state.target, state.delay_ms

    senders.start(parse_target(url))
    senders.set_delay(0.09)
    assert shown() == (url.replace("120", "90"), 90.0)
    senders.set_delay(0.0)
    assert shown() == (url.replace("delay=120&", ""), 0.0)
    senders.start(parse_target(url))
    assert shown() == (url, 120.0)


def test_media_time_continues_at_rest(senders: SenderPool, receiver: socket.socket) -> None:
    def next_time_s() -> float:
        while (first := next(iter(OscBundle(receiver.recv(2000))))).address != "/kouxing/time":
            pass
        return float(first.params[0])

    senders.start(parse_target(f"osc://127.0.0.1:{receiver.getsockname()[1]}"))
    assert 0.0 <= next_time_s() < LIMIT_S
    senders.show(1000.0, OPEN_MOUTH)
    while next_time_s() < 1000.0:
        pass
    rest_s = [next_time_s() for _ in range(5)]
    assert 1000.0 + STALL_S <= rest_s[0] < 1000.0 + LIMIT_S
    assert all(0 < step_s < LIMIT_S for step_s in np.diff(rest_s))


def test_the_permission_of_vtube_studio_is_requested_once(senders: SenderPool) -> None:
    port = free_port()
    with VTubeStudioStub(port) as stub:
        url = f"vts://127.0.0.1:{port}"
        senders.start(parse_target(url))
        wait_until(lambda: bool(stub.frames))
        assert stub.requests == [
            "AuthenticationTokenRequest", "AuthenticationRequest", "InputParameterListRequest",
        ]  # fmt: skip
        assert stub.frames[0]["MouthOpen"] == 0.0
        senders.show(0.0, OPEN_MOUTH)
        wait_until(lambda: stub.frames[-1]["MouthOpen"] > 0.9)
    wait_until(lambda: "start it" in problem_of(senders, url))
    with VTubeStudioStub(port, token="a-token") as stub:  # restarted; it accepts the token
        wait_until(lambda: bool(stub.frames))
        assert stub.requests == ["AuthenticationRequest", "InputParameterListRequest"]
        assert problem_of(senders, url) == ""
        senders.stop(parse_target(url))
        senders.start(parse_target(f"vts://localhost:{port}"))
        wait_until(lambda: len(stub.requests) == 4)
        assert stub.requests[2:] == ["AuthenticationRequest", "InputParameterListRequest"]


def test_a_sender_can_be_stopped_while_its_connection_ends(
    senders: SenderPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_writing, is_ending = threading.Event(), threading.Event()

    async def write(*_: object) -> None:
        is_writing.set()
        try:
            await asyncio.sleep(LIMIT_S)
        finally:
            is_ending.set()
            await asyncio.sleep(LIMIT_S)

    monkeypatch.setattr(VTubeStudioConnection, "_write", write)
    with VTubeStudioStub() as stub:
        senders.start(parse_target(f"vts://127.0.0.1:{stub.port}"))
        assert is_writing.wait(LIMIT_S)
    assert is_ending.wait(LIMIT_S)
    senders.close()


def test_vtube_studio_is_not_asked_again_after_a_denial(
    senders: SenderPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, has_ended = VTubeStudioConnection.run, threading.Event()

    async def run_to_its_end(self: VTubeStudioConnection) -> None:
        await run(self)
        has_ended.set()

    monkeypatch.setattr(VTubeStudioConnection, "run", run_to_its_end)
    with VTubeStudioStub(user_allows=False) as stub:
        url = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(url))
        assert has_ended.wait(LIMIT_S)
        assert "denied" in problem_of(senders, url)
        assert stub.requests == ["AuthenticationTokenRequest"]


def test_new_options_replace_a_sender_and_keep_its_permission(senders: SenderPool) -> None:
    with VTubeStudioStub() as stub:
        whole_face = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(whole_face))
        wait_until(lambda: bool(stub.frames))
        mouth = f"{whole_face}?only=mouth"
        senders.start(parse_target(mouth))
        wait_until(lambda: any("EyeOpenLeft" not in frame for frame in stub.frames))
        assert stub.requests.count("AuthenticationTokenRequest") == 1
        assert [state.target for state in senders.states()] == [mouth]
        senders.stop(parse_target(whole_face))  # options do not matter
        assert senders.states() == []


def test_a_tracker_passes_through_with_the_mouth_of_the_session(
    senders: SenderPool, receiver: socket.socket
) -> None:
    port, camera = receiver.getsockname()[1], free_udp_port()
    target = parse_target(f"livelink://127.0.0.1:{port}?camera={camera}")
    senders.start(target)
    wait_until(lambda: senders.states()[0].rate_hz > 0)  # both sockets are open
    senders.show(1.0, OPEN_MOUTH)
    tracked = FaceFrame(SHAPE_SETS["arkit"].faps(np.eye(52, dtype=np.float32)[0]), 0.0)
    packet = LiveLinkConnection(parse_target("livelink://?name=Phone")).encode_at(tracked, 0.0)
    names = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tracker:
        while "Phone" not in names:
            for sent in (b"", b"bad", packet):
                tracker.sendto(sent, ("127.0.0.1", camera))
            fields = read_live_link(receiver.recv(2048))
            names.add(fields["name"])
    assert fields["values"][LIVE_LINK_ORDER.index("jawOpen")] > 0.3
    blink = SHAPE_SETS["arkit"].names[0]
    assert fields["values"][LIVE_LINK_ORDER.index(blink)] == pytest.approx(1.0, abs=0.05)


def test_an_occupied_tracker_port_is_reported_once(
    senders: SenderPool, receiver: socket.socket, reports: list[tuple[str, str]]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        camera = free_udp_port()
        other.bind(("127.0.0.1", camera))
        url = f"vmc://127.0.0.1:{receiver.getsockname()[1]}?camera={camera}"
        senders.start(parse_target(url))
        wait_until(lambda: f"cannot receive from a tracker on 127.0.0.1:{camera}" in str(reports))
        for _ in range(20):  # packets of the face at rest, during many attempts to open the port
            receiver.recv(2048)
    wait_until(lambda: not problem_of(senders, url))
    wait_until(lambda: not reports[-1][1])
    assert len(reports) == 2
