"""The state of a system of any size, in pages."""

import contextlib
import secrets

import pytest

from kouxing.services.control import status_reporter as control_status
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from kouxing.shared.settings.endpoints import key_of
from kouxing.shared.settings.keys import load_key
from kouxing.shared.wire.control import Heartbeat
from kouxing.shared.wire.session import Error, StatusReport, StatusRequest
from tests.control_harness import ControlHarness


def ask(harness: ControlHarness, client: Socket, **fields: object) -> StatusReport | Error:
    """Return the answer to a status request."""
    request = secrets.token_hex(4)  # control repeats the answer to a known request
    client.send(StatusRequest(request=request, **fields))  # type: ignore[arg-type]
    while not isinstance(answer := harness.receive(client)[-1], StatusReport | Error):
        pass
    return answer


def open_sessions(harness: ControlHarness, number: int) -> list[str]:
    names = [f"s{item}" for item in range(number)]
    raw = harness.connect_client(None)
    for name in names:
        harness.open(raw, name, request=name)
    return names


def test_pages_contain_everything_once(
    harness: ControlHarness, client: Socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = open_sessions(harness, 5)
    full_report = ask(harness, client)
    assert isinstance(full_report, StatusReport)
    assert full_report.next is None
    monkeypatch.setattr(control_status, "PAGE_BYTES", 700)
    services, sessions, after, num_pages = [], [], 0, 0
    while True:
        page = ask(harness, client, after=after)
        assert isinstance(page, StatusReport)
        services += [state.instance for state in page.services]
        sessions += [state.session for state in page.sessions]
        num_pages += 1
        if page.next is None:
            break
        assert page.next > after
        after = page.next
    assert num_pages >= 3
    assert services == [state.instance for state in full_report.services]
    assert sessions == names == [state.session for state in full_report.sessions]


def test_reports_one_session_and_its_services(harness: ControlHarness, client: Socket) -> None:
    open_sessions(harness, 3)
    report = ask(harness, client, session="s1")
    assert isinstance(report, StatusReport)
    assert [state.session for state in report.sessions] == ["s1"]
    assert {state.instance for state in report.services} == {"recognizer", "synthesizer"}
    harness.control._recovery.is_active = False
    assert getattr(ask(harness, client, session="none"), "code", "") == "unknown-session"


@pytest.mark.usefixtures("new_keys")
def test_only_clients_and_services_see_the_token_of_the_web_page() -> None:
    page = "https://face.example:8080/"
    heartbeat = Heartbeat(
        service="gateway", instance="gateway", role="observer", state="ready", sent_ns=0,
        endpoints={"page": f"{page}#token=secret"},
    )  # fmt: skip
    told: dict[str, str] = {}
    with (
        contextlib.closing(ControlHarness(insecure=False)) as harness,
        contextlib.ExitStack() as buses,
    ):
        for role in ("service:gateway", "client", "subscriber:*", "subscriber:s", "operator"):
            bus = buses.enter_context(Bus(load_key(f"key-{len(told)}", (role,))))
            asker = bus.connect_dealer(harness.control.endpoints["commands"])
            if role.startswith("service"):
                asker.send(heartbeat)
            report = ask(harness, asker)
            assert isinstance(report, StatusReport)
            endpoints = {state.service: state.endpoints for state in report.services}
            told[role] = endpoints["gateway"]["page"].removeprefix(page)
            assert len(key_of(endpoints["recognizer"]["audio"])) == 40, "it may have a '#'"
    assert told == {
        "service:gateway": "#token=secret",
        "client": "#token=secret",
        "subscriber:*": "",
        "subscriber:s": "",
        "operator": "",
    }
