"""The address by which others reach this host."""

from typing import Self

import pytest
from kouxing_client.field_types import MAX_ENDPOINT

from kouxing.services.control.config import ControlConfig
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.settings.endpoints import local_address, with_key

KEY_LENGTH = 40  # characters of a public key
ROUTES = {"10.77.0.1": "10.77.0.2", "fd77::1": "fd77::2", "192.0.2.1": "10.88.0.2"}


class Probe:
    """The socket of a host with two networks and a default route."""

    routes = ROUTES

    def __init__(self, *_: object) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def connect(self, address: tuple[str, int]) -> None:
        if address[0] not in self.routes:
            raise OSError("no route")
        self._own = self.routes[address[0]]

    def getsockname(self) -> tuple[str, int]:
        return self._own, 9


@pytest.mark.parametrize(
    ("control", "bound", "advertised"),
    [
        ("tcp://10.77.0.1:5550", "tcp://0.0.0.0:5571", "tcp://10.77.0.2:5571"),
        ("tcp://[fd77::1]:5550", "tcp://[::]:5571", "tcp://[fd77::2]:5571"),
        ("tcp://localhost:5550", "tcp://0.0.0.0:5571", "tcp://10.88.0.2:5571"),
    ],
)
def test_advertises_the_address_on_the_way_to_control(
    monkeypatch: pytest.MonkeyPatch, control: str, bound: str, advertised: str
) -> None:
    monkeypatch.setattr("socket.socket", Probe)
    assert SynthesizerConfig(control=control).advertised_endpoint(bound) == advertised
    monkeypatch.setattr(Probe, "routes", {})
    assert local_address("10.77.0.1") == "127.0.0.1", "a host without network reaches itself"


def test_control_on_a_host_without_ipv4_advertises_its_ipv6_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("socket.socket", Probe)
    monkeypatch.setattr(Probe, "routes", {"2001:db8::1": "fd77::2"})
    config = ControlConfig(control="tcp://[::]:5550", events="tcp://[::]:5551")
    assert config.advertised_endpoint(config.events) == "tcp://[fd77::2]:5551"


def test_the_longest_host_name_fits_into_a_message() -> None:
    config = SynthesizerConfig(advertise=190 * "h")
    endpoint = with_key(config.advertised_endpoint("tcp://0.0.0.0:55710"), KEY_LENGTH * "k")
    assert len(endpoint) <= MAX_ENDPOINT
