"""Addresses by which others reach this host, with network interfaces of their own."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.system import ROOT

pytestmark = pytest.mark.unit
INTERFACES = """
ip link add inside type veth peer name inside-end
ip link add outside type veth peer name outside-end
ip address add 10.77.0.2/24 dev inside
ip address add fd77::2/64 dev inside nodad
ip address add 10.88.0.2/24 dev outside
for each in lo inside inside-end outside outside-end; do ip link set $each up; done
ip route add default via 10.88.0.1
exec "$@"
"""


def with_own_network(command: list[str]) -> str:
    """Return what a command prints that has a network of its own."""
    unshare = ["unshare", "--net"]
    if subprocess.run([*unshare, "true"], stderr=subprocess.DEVNULL, check=False).returncode:
        unshare.append("--map-root-user")  # whoever is not root
    printed = subprocess.run([*unshare, *command], cwd=ROOT, check=True, stdout=subprocess.PIPE)
    return printed.stdout.decode().strip()


@pytest.mark.parametrize(
    ("control", "bound", "told"),
    [
        ("tcp://10.77.0.1:5550", "tcp://0.0.0.0:5571", "tcp://10.77.0.2:5571"),
        ("tcp://[fd77::1]:5550", "tcp://[::]:5571", "tcp://[fd77::2]:5571"),
        ("tcp://10.99.0.1:5550", "tcp://0.0.0.0:5571", "tcp://10.88.0.2:5571"),
        ("tcp://localhost:5550", "tcp://0.0.0.0:5571", "tcp://10.88.0.2:5571"),
    ],
)
def test_what_is_bound_to_every_address_is_advertised_by_the_one_on_the_way_to_control(
    control: str, bound: str, told: str
) -> None:
    program = (
        "from kouxing.services.synthesizer.config import SynthesizerConfig;"
        f"print(SynthesizerConfig(control={control!r}).reachable({bound!r}))"
    )
    command = ["sh", "-ec", INTERFACES, "sh", sys.executable, "-c", program]
    assert with_own_network(command) == told


def test_a_host_without_network_reaches_itself() -> None:
    program = "from kouxing.shared.endpoints import own_address; print(own_address('10.77.0.1'))"
    assert with_own_network([sys.executable, "-c", program]) == "127.0.0.1"
