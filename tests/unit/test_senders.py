"""Frames at programs that listen, do not listen, come back, or are to get them later."""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_server import BlockingOSCUDPServer
from websockets.sync import client as websockets

from kouxing.services.senders.playout import PAUSE_S, WINDOW_S, Playout
from kouxing.services.senders.senders import MAX_SENDERS, STALL_S, Senders
from kouxing.services.senders.target import parse_target
from kouxing.shared.errors import UserError
from kouxing.shared.face.shapes import SHAPE_SETS
from tests.vtube_studio import VTubeStudioStub

pytestmark = pytest.mark.unit

LIMIT_S = 20.0


def open_mouth() -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Return FAPs of a wide open mouth."""
    vrm = SHAPE_SETS["vrm"]
    return vrm.faps(np.array([name == "aa" for name in vrm.names], np.float32))


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture
def reports() -> list[tuple[str, str]]:
    return []


@pytest.fixture
def senders(reports: list[tuple[str, str]]) -> Iterator[Senders]:
    with contextlib.closing(Senders(0, lambda *report: reports.append(report))) as made:
        yield made


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(LIMIT_S)
        yield made


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(is_so: Callable[[], bool]) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def problem(senders: Senders, url: str) -> str:
    return next(state.problem for state in senders.states() if state.target == url)


# --- over UDP -----------------------------------------------------------------------------------


def test_an_osc_server_receives_the_face(senders: Senders) -> None:
    opened: list[float] = []

    def receive(_address: str, name: str, value: float) -> None:
        if name == "A":
            opened.append(value)

    dispatcher = Dispatcher()
    dispatcher.map("/VMC/Ext/Blend/Val", receive)
    with BlockingOSCUDPServer(("127.0.0.1", 0), dispatcher) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            senders.start(parse_target(f"vmc://127.0.0.1:{server.server_address[1]}"))
            wait_until(lambda: bool(opened))
            assert opened[0] == 0.0  # nobody speaks: a face at rest
            senders.accept(0.0, open_mouth())
            wait_until(lambda: opened[-1] > 0.8)
        finally:
            server.shutdown()
            thread.join()


def test_a_program_that_does_not_listen_is_named_and_found_again(
    senders: Senders, receiver: socket.socket, reports: list[tuple[str, str]]
) -> None:
    port = free_port()
    missing = f"osc://127.0.0.1:{port}"
    there = f"osc://127.0.0.1:{receiver.getsockname()[1]}"
    senders.start(parse_target(missing))
    senders.start(parse_target(there))
    wait_until(lambda: "no program listens" in problem(senders, missing))
    assert receiver.recv(2000)  # others go on
    assert problem(senders, there) == ""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(("127.0.0.1", port))
        wait_until(lambda: not problem(senders, missing))
        late.settimeout(LIMIT_S)
        assert late.recv(2000)
    wait_until(lambda: len(reports) >= 2)
    assert [url for url, _ in reports[:2]] == [missing, missing]
    assert (bool(reports[0][1]), reports[1][1]) == (True, "")


def test_a_host_that_cannot_be_found_does_not_keep_others_waiting(
    senders: Senders, receiver: socket.socket
) -> None:
    lost = "vmc://nowhere.invalid"
    senders.start(parse_target(lost))
    senders.start(parse_target(f"livelink://127.0.0.1:{receiver.getsockname()[1]}"))
    assert receiver.recv(2000)
    wait_until(lambda: "nowhere.invalid cannot be reached" in problem(senders, lost))


def test_frames_leave_again_after_the_network_has_changed(
    senders: Senders, receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[socket.socket] = []

    class Counted(socket.socket):
        def connect(self, address: object) -> None:
            opened.append(self)
            super().connect(address)  # type: ignore[arg-type]

        def send(self, data: bytes) -> int:  # type: ignore[override]
            if self is opened[0]:
                raise OSError(errno.ENETUNREACH, "Network is unreachable")
            return super().send(data)

    monkeypatch.setattr(socket, "socket", Counted)
    url = f"osc://127.0.0.1:{receiver.getsockname()[1]}"
    senders.start(parse_target(url))
    wait_until(lambda: "Network is unreachable" in problem(senders, url))
    assert receiver.recv(2000)
    wait_until(lambda: problem(senders, url) == "")


def test_an_address_of_ip_version_6_is_reached(senders: Senders) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as program:
        try:
            program.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
        program.settimeout(LIMIT_S)
        senders.start(parse_target(f"livelink://[::1]:{program.getsockname()[1]}"))
        assert program.recv(2000)[0] == 6


def test_senders_start_and_stop_while_others_run(senders: Senders, receiver: socket.socket) -> None:
    url = f"livelink://localhost:{receiver.getsockname()[1]}"
    senders.start(parse_target(url))
    senders.start(parse_target(url))  # again
    assert receiver.recv(2000)
    wait_until(lambda: senders.states()[0].rate_hz > 0)
    (state,) = senders.states()
    assert (state.target, state.contents) == (url, "ARKit shapes and head")
    senders.stop(url)
    senders.stop(url)
    assert senders.states() == []
    for number in range(MAX_SENDERS):
        senders.start(parse_target(f"osc://127.0.0.1:{9 + number}"))
    with pytest.raises(UserError, match="stop one first"):
        senders.start(parse_target(url))


def test_a_delayed_sender_gets_each_frame_later(senders: Senders) -> None:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as soon,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late,
    ):
        for each, delay_ms in ((late, 10_000), (soon, 50)):
            each.bind(("127.0.0.1", 0))
            port = each.getsockname()[1]
            senders.start(parse_target(f"osc://127.0.0.1:{port}?delay={delay_ms}"))
        soon.setblocking(False)
        times_s: list[float] = []
        while len(times_s) < 10:
            time.sleep(0.002)
            senders.accept(1000.0 + len(times_s), open_mouth())
            with contextlib.suppress(BlockingIOError):
                times_s.append(next(iter(OscBundle(soon.recv(2000)))).params[0])
        late.setblocking(False)
        with pytest.raises(BlockingIOError):
            late.recv(2000)


def test_all_programs_are_delayed_alike_while_frames_wait(
    senders: Senders, receiver: socket.socket
) -> None:
    url = f"osc://127.0.0.1:{receiver.getsockname()[1]}"
    senders.start(parse_target(f"{url}?delay=10000"))
    senders.accept(1000.0, open_mouth())
    receiver.setblocking(False)
    time.sleep(0.1)
    with pytest.raises(BlockingIOError):
        receiver.recv(2000)
    senders.delay(0.05)  # what waits is due
    receiver.settimeout(LIMIT_S)
    while next(iter(OscBundle(receiver.recv(2000)))).params[0] != 1000.0:
        pass
    assert [state.delay_ms for state in senders.states()] == [50.0]
    senders.delay(10.0)
    time.sleep(0.1)  # for what was due
    receiver.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            receiver.recv(2000)
    for number in range(5):
        senders.accept(1001.0 + number, open_mouth())
    time.sleep(0.2)
    with pytest.raises(BlockingIOError):
        receiver.recv(2000)


def test_a_face_without_frames_goes_to_rest(senders: Senders, receiver: socket.socket) -> None:
    senders.accept(0.0, open_mouth())
    senders.start(parse_target(f"vmc://127.0.0.1:{receiver.getsockname()[1]}"))
    began_s = time.monotonic()
    receiver.recv(2000)
    assert time.monotonic() - began_s > STALL_S / 2


def test_time_goes_on_at_rest(senders: Senders, receiver: socket.socket) -> None:
    def next_time_s() -> float:
        while (first := next(iter(OscBundle(receiver.recv(2000))))).address != "/kouxing/time":
            pass
        return float(first.params[0])

    senders.start(parse_target(f"osc://127.0.0.1:{receiver.getsockname()[1]}"))
    assert 0.0 <= next_time_s() < LIMIT_S  # nobody has spoken
    senders.accept(1000.0, open_mouth())
    while next_time_s() < 1000.0:
        pass
    rest_s = [next_time_s() for _ in range(5)]
    assert 1000.0 + STALL_S <= rest_s[0] < 1000.0 + LIMIT_S
    assert all(0 < step_s < LIMIT_S for step_s in np.diff(rest_s))


# --- to VTube Studio ----------------------------------------------------------------------------


def test_vtube_studio_asks_once_and_shows_the_face(senders: Senders) -> None:
    with VTubeStudioStub() as stub:
        url = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(url))
        wait_until(lambda: bool(stub.frames))
        assert stub.requests == [
            "AuthenticationTokenRequest", "AuthenticationRequest", "InputParameterListRequest",
        ]  # fmt: skip
        assert stub.frames[0]["MouthOpen"] == 0.0
        senders.accept(0.0, open_mouth())
        wait_until(lambda: stub.frames[-1]["MouthOpen"] > 0.9)
        port = stub.port
    wait_until(lambda: "start it" in problem(senders, url))
    with VTubeStudioStub(port, token="a-token") as stub:  # it comes back, and knows the token
        wait_until(lambda: bool(stub.frames))
        assert stub.requests == ["AuthenticationRequest", "InputParameterListRequest"]
        assert problem(senders, url) == ""


@pytest.mark.parametrize(
    ("kind", "changed", "data", "number"),
    [
        ("AuthenticationTokenRequest", {"apiName": "VTubeStudio"}, {}, 3),
        ("AuthenticationTokenRequest", {"apiVersion": "2.0"}, {}, 4),
        ("AuthenticationTokenRequest", {"requestID": "-"}, {}, 5),
        ("AuthenticationTokenRequest", {}, {"pluginName": "k"}, 52),
        ("AuthenticationTokenRequest", {}, {"pluginDeveloper": "k" * 33}, 53),
        ("AuthenticationRequest", {}, {"authenticationToken": ""}, 100),
        ("AuthenticationRequest", {}, {"pluginName": ""}, 101),
        ("AuthenticationRequest", {}, {"pluginDeveloper": ""}, 102),
        ("MoveRequest", {}, {}, 7),
        ("InjectParameterDataRequest", {}, {"parameterValues": []}, 450),
        ("InjectParameterDataRequest", {}, {"mode": "mix"}, 455),
        (
            "InjectParameterDataRequest",
            {},
            {"parameterValues": [{"id": "MouthOpen", "value": 2e6}]},
            451,
        ),
        ("InjectParameterDataRequest", {}, {"parameterValues": [{"id": "Jaw", "value": 1}]}, 453),
    ],
)
def test_the_vtube_studio_of_these_tests_refuses_what_the_true_one_does(
    kind: str, changed: dict[str, str], data: dict[str, object], number: int
) -> None:
    plugin = {"pluginName": "kouxing", "pluginDeveloper": "kouxing", "authenticationToken": "t"}
    values = {"parameterValues": [{"id": "MouthOpen", "value": 1.0}], "mode": "set"}
    request = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0", "requestID": "1"}
    with (
        VTubeStudioStub(token="t") as stub,
        websockets.connect(f"ws://127.0.0.1:{stub.port}") as api,
    ):

        def ask(kind: str, changed: dict[str, str], data: dict[str, object]) -> dict[str, Any]:
            api.send(json.dumps({**request, "messageType": kind, "data": data} | changed))
            return dict(json.loads(api.recv(LIMIT_S)))

        assert ask("AuthenticationRequest", {}, {**plugin})["data"]["authenticated"]
        answer = ask("InjectParameterDataRequest", {}, {**values})
        assert answer["messageType"] == "InjectParameterDataResponse"
        answer = ask(kind, changed, {**plugin, **values, **data})
        assert (answer["messageType"], answer["data"]["errorID"]) == ("APIError", number)


def test_a_user_who_denies_is_not_asked_again(senders: Senders) -> None:
    with VTubeStudioStub(user_allows=False) as stub:
        url = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(url))
        wait_until(lambda: "denied" in problem(senders, url))
        time.sleep(1.2)  # longer than it waits to connect again
        assert stub.requests == ["AuthenticationTokenRequest"]


def test_a_question_that_is_still_open_is_waited_for(senders: Senders) -> None:
    with VTubeStudioStub() as stub:
        stub.is_asking = True
        url = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(url))
        wait_until(lambda: len(stub.requests) > 1)  # asked again
        assert "press Allow" in problem(senders, url)
        stub.is_asking = False
        wait_until(lambda: bool(stub.frames))


def test_a_permission_that_is_taken_back_is_asked_for_again(senders: Senders) -> None:
    with VTubeStudioStub() as stub:
        url = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(url))
        wait_until(lambda: bool(stub.frames))
        stub.token = ""
        stub.requests.clear()
        wait_until(lambda: "AuthenticationTokenRequest" in stub.requests)
        shown = len(stub.frames)
        wait_until(lambda: len(stub.frames) > shown)
        assert problem(senders, url) == ""


def test_two_senders_to_one_vtube_studio_share_its_permission(senders: Senders) -> None:
    with VTubeStudioStub() as stub:
        whole = f"vts://127.0.0.1:{stub.port}"
        senders.start(parse_target(whole))
        wait_until(lambda: bool(stub.frames))
        mouth = f"{whole}?only=mouth"
        senders.start(parse_target(mouth))
        wait_until(lambda: any("EyeOpenLeft" not in frame for frame in stub.frames))
        assert stub.requests.count("AuthenticationTokenRequest") == 1
        senders.stop(whole)
        shown = len(stub.frames)
        wait_until(lambda: len(stub.frames) > shown + 5)
        assert "EyeOpenLeft" not in stub.frames[-1]


def test_what_is_no_vtube_studio_is_said(senders: Senders) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:  # takes connections, says nothing
        url = f"vts://127.0.0.1:{other.getsockname()[1]}"
        senders.start(parse_target(url))
        accepted, _ = other.accept()
        accepted.sendall(b"220 mail\r\n")
        accepted.close()
        wait_until(lambda: "no VTube Studio" in problem(senders, url))


# --- the time at which a frame leaves -------------------------------------------------------------


def test_frames_leave_at_their_own_pace() -> None:
    playout, rng = Playout(), np.random.default_rng(0)
    jitter_s = rng.uniform(0.0, 0.05, 500)
    jitter_s[3] = 0.0
    best_s = [
        playout.best_s(number / 50, 100.0 + number / 50 + late_s)
        for number, late_s in enumerate(jitter_s)
    ]
    steps_s = np.diff(best_s[int(WINDOW_S * 50) :])
    assert np.abs(steps_s - 0.02).max() < 0.005
    assert all(best <= 100.0 + n / 50 + jitter_s[n] for n, best in enumerate(best_s))


def test_a_clock_that_drifts_is_followed() -> None:
    playout = Playout()
    late_s = [
        (now_s := number / 50 * 1.001) - playout.best_s(number / 50, now_s)
        for number in range(5000)
    ]
    assert max(late_s) < 2 * WINDOW_S * 0.0011


def test_after_a_pause_the_delay_is_as_before() -> None:
    playout = Playout()
    for number in range(100):
        playout.best_s(number / 50, number / 50)
    standing_s = 99 / 50
    for number in range(100, 150):  # the face comes to rest: media time stands still
        playout.best_s(standing_s, number / 50)
    resumed_s = [playout.best_s(standing_s + n / 50, 3.0 + n / 50) for n in range(1, 50)]
    assert resumed_s == pytest.approx([3.0 + n / 50 for n in range(1, 50)], abs=0.021)
    later_s = 10.0 + PAUSE_S  # nothing came meanwhile
    assert playout.best_s(3.0, later_s) == later_s
    assert playout.best_s(0.0, later_s) == later_s  # another session
