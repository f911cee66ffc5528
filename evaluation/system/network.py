"""Virtual hosts: network namespaces around a router that loses, delays and blocks packets.

A veth pair connects each host to the router. nftables drops packets there. A TUN device sends them
through ``evaluation.system.packet_delay``, because not every kernel has netem. This needs Linux,
root, iproute2 and nftables.
"""

import contextlib
import ctypes
import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from kouxing.evaluation.system.wait import wait_until
from kouxing.shared.errors import UserError

TOOLS = ("ip", "nft", "nsenter")
DELAY_DEVICE = "delay"
_CLONE_NEWNET = 0x40000000
_READY_S = 10.0


@dataclass(frozen=True, slots=True)
class NetworkLink:
    """Properties of the connection between two hosts; packets keep their order."""

    delay_ms: float = 0.0
    loss: float = 0.0  # fraction of lost packets


class Network:
    """Up to 250 hosts with one address each; their names have up to 15 letters.

    Raises ``UserError`` if this process is not root, a tool is missing, or namespaces are
    forbidden.
    """

    def __init__(self, hosts: Sequence[str], link: NetworkLink) -> None:
        missing = [tool for tool in TOOLS if shutil.which(tool) is None]
        if missing or os.geteuid() != 0:
            need = f"install {' and '.join(missing)}" if missing else "run it as root"
            raise UserError(f"virtual hosts need Linux network namespaces: {need}")
        self._addresses = {host: f"10.77.{n}.2" for n, host in enumerate(hosts, start=1)}
        self._link = link
        self._name = f"kouxing-{secrets.token_hex(3)}"
        self._router = f"{self._name}-router"
        self._delayer: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self._build()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._delayer is not None:
            self._delayer.terminate()
            self._delayer.wait()
        for namespace in (self._router, *map(self._namespace, self._addresses)):
            with contextlib.suppress(UserError):  # the namespace does not exist
                _run_command("ip", "netns", "delete", namespace)

    def address(self, host: str) -> str:
        """Return the address of a host."""
        return self._addresses[host]

    def command(self, host: str, *command: str) -> list[str]:
        """Return a command line that runs a command on a host."""
        return _command(self._namespace(host), *command)

    def on(self, host: str) -> contextlib.AbstractContextManager[None]:
        """Open the sockets of this thread, and of threads that it starts, on a host."""
        return _in_namespace(self._namespace(host))

    def cut(self, host: str) -> None:
        """Drop all packets from and to a host, without closing connections."""
        address = self._addresses[host]
        for side in ("saddr", "daddr"):
            self._rule(f"ip {side} {address} drop", chain="cuts")

    def restore(self) -> None:
        """Connect all hosts again."""
        self._on_router("nft", "flush", "chain", "inet", "network", "cuts")

    def _build(self) -> None:
        _run_command("ip", "netns", "add", self._router)
        with _in_namespace(self._router):
            Path("/proc/sys/net/ipv4/ip_forward").write_text("1")
        for host, address in self._addresses.items():
            namespace, router = self._namespace(host), address.removesuffix("2") + "1"
            _run_command("ip", "netns", "add", namespace)
            ends = ("link", "add", "name", host, "type", "veth", "peer", "name", "uplink")
            self._on_router("ip", *ends, "netns", namespace)
            self._on_router("ip", "address", "add", f"{router}/24", "dev", host)
            self._on_router("ip", "link", "set", "dev", host, "up")
            for arguments in (
                ("address", "add", f"{address}/24", "dev", "uplink"),
                ("link", "set", "uplink", "up"),
                ("link", "set", "lo", "up"),
                ("route", "add", "default", "via", router),
            ):
                _run_command(*self.command(host, "ip", *arguments))
        self._on_router("nft", "add table inet network")
        for chain in ("cuts", "loss"):
            form = "{ type filter hook forward priority 0; }"
            self._on_router("nft", f"add chain inet network {chain} {form}")
        if self._link.loss:
            lost_of_10000 = round(1e4 * self._link.loss)
            not_delayed = f'iifname != "{DELAY_DEVICE}"'  # a delayed packet is forwarded twice
            self._rule(
                f"{not_delayed} numgen random mod 10000 < {lost_of_10000} drop", chain="loss"
            )
        if self._link.delay_ms:
            self._start_delay()

    def _start_delay(self) -> None:
        """Send all packets of hosts through a process that returns them later."""
        module = [sys.executable, "-m", "kouxing.evaluation.system.packet_delay", DELAY_DEVICE]
        delay_ms = self._link.delay_ms
        jitter_ms = delay_ms / 5  # largest random change of the delay
        self._delayer = subprocess.Popen(  # noqa: S603 - our own module
            _command(self._router, *module, str(delay_ms), str(jitter_ms))
        )
        show = ("ip", "-brief", "link", "show", "up")
        if not wait_until(lambda: DELAY_DEVICE in self._on_router(*show), _READY_S):
            raise UserError("cannot delay packets; check that /dev/net/tun exists")
        self._on_router("ip", "route", "add", "default", "dev", DELAY_DEVICE, "table", "77")
        for host in self._addresses:
            self._on_router("ip", "rule", "add", "iif", host, "table", "77")

    def _rule(self, rule: str, *, chain: str) -> None:
        self._on_router("nft", f"add rule inet network {chain} {rule}")

    def _on_router(self, *command: str) -> str:
        return _run_command(*_command(self._router, *command))

    def _namespace(self, host: str) -> str:
        return f"{self._name}-{host}"


def _command(namespace: str, *command: str) -> list[str]:
    """Return a command line for a namespace, like 'ip netns exec', which fails in a chroot."""
    return ["nsenter", f"--net=/run/netns/{namespace}", *command]


def _run_command(*command: str) -> str:
    """Run a command and return its output; raises ``UserError`` with its errors if it fails."""
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if result.returncode != 0:
        raise UserError(f"{' '.join(command)}: {result.stderr.strip()}")
    return result.stdout


@contextlib.contextmanager
def _in_namespace(namespace: str) -> Iterator[None]:
    with Path("/proc/thread-self/ns/net").open() as previous:
        with Path("/run/netns", namespace).open() as target:
            _enter(target.fileno())
        try:
            yield
        finally:
            _enter(previous.fileno())


def _enter(namespace: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, _CLONE_NEWNET) != 0:
        raise UserError(f"cannot enter a network namespace: {os.strerror(ctypes.get_errno())}")
