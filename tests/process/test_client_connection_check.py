"""Why an address cannot be reached."""

import socket
import threading
from unittest.mock import Mock

import pytest
from kouxing_client.connection_check import explain_unreachable

from tests.system import LIMIT_S


def test_a_silent_name_server_is_reported() -> None:
    is_over = threading.Event()
    look_up = Mock(side_effect=lambda *_, **__: is_over.wait())
    reason = explain_unreachable("lab", "7700", 0.0, look_up=look_up)
    is_over.set()
    assert "no name server answers for the host name 'lab'; check the network" in reason


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (socket.gaierror(-2, "unknown"), "the host name 'lab' is unknown"),
        (UnicodeError("label too long"), "the host name 'lab' is unknown"),
        (OSError(24, "Too many open files"), "Too many open files; check the address"),
    ],
)
def test_a_failed_look_up_is_explained(error: Exception, reason: str) -> None:
    look_up = Mock(side_effect=error)
    assert reason in explain_unreachable("lab", "7700", LIMIT_S, look_up=look_up)


def test_a_name_with_only_ipv6_addresses_is_reported() -> None:
    address = (socket.AF_INET6, socket.SOCK_STREAM, 0, "", ("fd77::1", 7700, 0, 0))
    look_up = Mock(return_value=[address])
    reason = explain_unreachable("lab", "7700", LIMIT_S, is_zeromq=True, look_up=look_up)
    assert "write its IPv6 address in brackets: [fd77::1]" in reason


def test_all_addresses_of_a_host_are_tried() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        addresses = [
            (socket.AF_INET, socket.SOCK_STREAM, 0, "", listener.getsockname())
            for listener in (closed, server)
        ]
        look_up = Mock(return_value=addresses)
        assert explain_unreachable("lab", "7700", LIMIT_S, look_up=look_up) == ""
        addresses.pop()
        reason = explain_unreachable("lab", "7700", LIMIT_S, look_up=look_up)
        assert "nothing listens there" in reason
