"""``kouxing doctor`` checks only the addresses that its host needs."""

from collections.abc import Mapping
from unittest import mock

import pytest
from kouxing_client import ServiceState

from kouxing.services.cli.system import doctor
from kouxing.shared.network.bus import Bus, ProbeResult

ELSEWHERE = {
    "recognizer": {"audio": "tcp://10.0.0.2:5560", "phones": "tcp://10.0.0.2:5561"},
    "synthesizer": {"phone_input": "tcp://10.0.0.3:5570", "faps": "tcp://10.0.0.3:5571"},
    "gateway": {"page": "http://127.0.0.1:8080/?token=t"},
}


def remedies(service: str, buses: Mapping[str, Bus], *, is_one_host: bool = False) -> list[str]:
    """Return what doctor reports about the endpoints of a service."""
    state = ServiceState(
        service=service, instance=service, role="worker", state="ready", age_s=0.0,
        clock_offset_ms=0.0, endpoints=ELSEWHERE[service], metrics={},
    )  # fmt: skip
    (check,) = doctor._check_service(state, buses, is_one_host=is_one_host)
    return check.remedy.splitlines()


def failed_endpoints(
    keys: list[str], monkeypatch: pytest.MonkeyPatch, *, is_one_host: bool = False
) -> set[str]:
    """Return the endpoints that doctor reports on a host with these keys that reaches none."""
    monkeypatch.setattr(doctor, "explain_unreachable", lambda *_, **__: "no route")
    buses: dict[str, Bus] = dict.fromkeys(keys, mock.create_autospec(Bus))
    return {
        line.partition(" ")[0]
        for service in ELSEWHERE
        for line in remedies(service, buses, is_one_host=is_one_host)
    }


@pytest.mark.parametrize(
    ("keys", "needed"),
    [
        (["recognizer"], {"audio", "phones", "phone_input"}),
        (["synthesizer"], {"phone_input", "faps"}),
        (["driver"], {"phones", "faps"}),
        (["client"], {"audio", "phones", "faps"}),
        (["gateway"], {"audio", "phones", "faps", "page"}),
        (["none"], {"audio", "phones", "phone_input", "faps", "page"}),
    ],
)
def test_checks_what_the_services_of_this_host_need(
    keys: list[str], needed: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert failed_endpoints(keys, monkeypatch) == needed


def test_checks_an_endpoint_with_each_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "explain_unreachable", lambda *_, **__: "")
    buses: dict[str, Bus] = {}
    for name, result in {"client": ProbeResult.ACCEPTED, "driver": ProbeResult.REJECTED}.items():
        buses[name] = bus = mock.create_autospec(Bus)
        bus.probe.return_value = result
    (remedy,) = remedies("synthesizer", buses)
    assert remedy.startswith("faps at tcp://10.0.0.3:5571: it does not accept the key driver")


def test_checks_the_page_on_the_only_host(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "page" in failed_endpoints(["client"], monkeypatch, is_one_host=True)
