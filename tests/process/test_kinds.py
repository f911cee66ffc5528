"""The registry of service kinds: every entry leads to a service that runs on its own."""

import contextlib
import errno
import socket
import sys
from unittest import mock

import pytest

from kouxing.services.cli.launch.run import assigned_environment, token_environment
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.service_kinds import (
    KINDS,
    available_port_environment,
    extra_worker_environments,
    free_port_environment,
    kind_of,
    read_settings,
)
from kouxing.shared.errors import UserError


@pytest.mark.parametrize("host", ["127.0.0.1", "*"])
def test_rejects_a_configured_port_that_is_taken(host: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        chosen = read_settings(assignments={"gateway.port": str(port)})
        with pytest.raises(UserError, match=f"gateway.port: another program uses port {port}"):
            available_port_environment(chosen)
        chosen = read_settings(
            assignments={
                "control.events": f"tcp://{host}:{port}",
                "control.advertise": "here",
                "control.insecure": "true",
            }
        )
        with pytest.raises(UserError, match=r"control\.events"):
            available_port_environment(chosen)


def test_reports_a_port_that_needs_privileges(monkeypatch: pytest.MonkeyPatch) -> None:
    refusal = mock.Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(socket, "create_server", refusal)
    chosen = read_settings(assignments={"gateway.port": "80"})
    with pytest.raises(UserError, match=r"gateway\.port: port 80 needs privileges"):
        available_port_environment(chosen)


def test_a_taken_default_and_port_0_are_replaced_by_a_free_port() -> None:
    taken = GatewayConfig().port
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # another program uses it, which has the same effect
            stack.enter_context(socket.create_server(("127.0.0.1", taken)))
        for settings in (read_settings(), read_settings(assignments={"gateway.port": "0"})):
            port = int(available_port_environment(settings)["KOUXING_GATEWAY_PORT"])
            assert port not in (0, taken)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux reserves ports")
def test_only_a_server_gets_a_reserved_port() -> None:
    with contextlib.ExitStack() as reservations:
        addresses = free_port_environment(["gateway"], reservations=reservations)
        address = "127.0.0.1", int(addresses["KOUXING_GATEWAY_PORT"])
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind(address)
        socket.create_server(address).close()
    with socket.socket() as other:
        other.bind(address)


@pytest.mark.parametrize(("https", "token"), [("proxy", ""), ("proxy", "secret"), ("", "")])
def test_a_gateway_that_is_restarted_keeps_its_token(https: str, token: str) -> None:
    settings = read_settings(assignments={"gateway.https": https, "gateway.token": token})
    environment = token_environment(settings)
    if https and not token:
        assert len(environment.pop("KOUXING_GATEWAY_TOKEN")) >= 20
    assert environment == {}


def test_a_common_key_is_set_for_the_services_that_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = assigned_environment({"common.head": "mika", "recognizer.acoustic": "light"})
    assert environment == {
        "KOUXING_HEAD": "mika",
        "KOUXING_DRIVER_HEAD": "mika",
        "KOUXING_GATEWAY_HEAD": "mika",
        "KOUXING_RECOGNIZER_ACOUSTIC": "light",
    }
    for name, text in environment.items():
        monkeypatch.setenv(name, text)
    for kind in KINDS.values():
        read_settings().load(kind.config_type)


def test_a_services_own_value_overrides_a_common_one() -> None:
    environment = assigned_environment({"gateway.head": "man", "common.head": "mika"})
    assert environment["KOUXING_GATEWAY_HEAD"] == "man"
    assert environment["KOUXING_DRIVER_HEAD"] == "mika"


def test_more_workers_bind_other_ports_of_the_same_address() -> None:
    settings = read_settings(
        assignments={"recognizer.audio": "tcp://127.0.0.5:5560", "recognizer.instance": "ours"}
    )
    assert extra_worker_environments(settings, 1) == {}
    more = extra_worker_environments(settings, 3)
    assert list(more) == ["recognizer-2", "recognizer-3", "synthesizer-2", "synthesizer-3"]
    assert more["recognizer-3"] == {
        "KOUXING_RECOGNIZER_INSTANCE": "",
        "KOUXING_RECOGNIZER_METRICS": "",
        "KOUXING_RECOGNIZER_AUDIO": "tcp://127.0.0.5:*",
        "KOUXING_RECOGNIZER_PHONES": "tcp://127.0.0.1:*",
        "KOUXING_RECOGNIZER_UNPACED_AUDIO": "tcp://127.0.0.1:*",
    }
    assert {kind_of(name) for name in more} < KINDS.keys()
