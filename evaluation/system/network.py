"""Hosts on this machine: network namespaces around a router, which loses, delays and cuts.

Each host is joined to the router by a veth pair. All packets between two hosts pass the router
once. There nftables drops some of them, and a TUN device leads them through
``evaluation.system.delay``, since not every kernel has netem. Needs Linux, root, iproute2 and
nftables.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import secrets
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from kouxing.shared.errors import UserError

TOOLS = ("ip", "nft", "nsenter")
DELAY_DEVICE = "delay"
_CLONE_NEWNET = 0x40000000
_READY_S = 10.0


@dataclass(frozen=True, slots=True)
class Link:
    """How packets get from one host to another; they keep their order."""

    delay_ms: float = 0.0
    loss: float = 0.0  # share of packets that do not arrive

    @property
    def jitter_ms(self) -> float:
        """How much more or less the delay may be, at random."""
        return self.delay_ms / 5


class Network:
    """Hosts by name, each with one address.

    Parameters
    ----------
    hosts
        Their names, at most 250, of up to 15 letters.
    link
        Between any two of them.

    Raises
    ------
    UserError
        If this is not root on a Linux system with ``TOOLS``, or namespaces are forbidden.
    """

    def __init__(self, hosts: Sequence[str], link: Link) -> None:
        missing = [tool for tool in TOOLS if shutil.which(tool) is None]
        if missing or os.geteuid() != 0:
            need = f"install {' and '.join(missing)}" if missing else "run it as root"
            raise UserError(f"hosts on this machine are network namespaces of Linux: {need}")
        self._addresses = {host: f"10.77.{n}.2" for n, host in enumerate(hosts, start=1)}
        self._link = link
        self._name = f"kouxing-{secrets.token_hex(3)}"
        self._router = f"{self._name}-router"
        self._delaying: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self._build()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._delaying is not None:
            self._delaying.terminate()
            self._delaying.wait()
        for namespace in (self._router, *map(self._namespace, self._addresses)):
            with contextlib.suppress(UserError):  # it was not made
                _call("ip", "netns", "delete", namespace)

    def bound(self, host: str) -> str:
        """Return the address that services of a host bind."""
        return self._addresses[host]

    def address(self, host: str, seen_from: str) -> str:
        """Return the address of a host for those on another one."""
        return self._addresses[host]

    def command(self, host: str, *command: str) -> list[str]:
        """Return the command that runs another one on a host."""
        return _command(self._namespace(host), *command)

    def on(self, host: str) -> contextlib.AbstractContextManager[None]:
        """Let this thread, and threads it starts meanwhile, open their sockets on a host."""
        return _in(self._namespace(host))

    def cut(self, host: str) -> None:
        """Lose all packets from and to a host from now on; no connection learns of it."""
        address = self._addresses[host]
        for side in ("saddr", "daddr"):
            self._rule(f"ip {side} {address} drop", chain="cuts")

    def mend(self) -> None:
        """End all cuts."""
        self._on_router("nft", "flush", "chain", "inet", "network", "cuts")

    def _build(self) -> None:
        _call("ip", "netns", "add", self._router)
        with _in(self._router):
            Path("/proc/sys/net/ipv4/ip_forward").write_text("1")
        for host, address in self._addresses.items():
            namespace, router = self._namespace(host), address.removesuffix("2") + "1"
            _call("ip", "netns", "add", namespace)
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
                _call(*self.command(host, "ip", *arguments))
        self._on_router("nft", "add table inet network")
        for chain in ("cuts", "loss"):
            form = "{ type filter hook forward priority 0; }"
            self._on_router("nft", f"add chain inet network {chain} {form}")
        if self._link.loss:
            share = round(1e4 * self._link.loss)
            once = f'iifname != "{DELAY_DEVICE}"'  # a delayed packet is forwarded twice
            self._rule(f"{once} numgen random mod 10000 < {share} drop", chain="loss")
        if self._link.delay_ms:
            self._delay()

    def _delay(self) -> None:
        """Lead what comes from hosts through a process that returns it later."""
        module = [sys.executable, "-m", "kouxing.evaluation.system.delay", DELAY_DEVICE]
        delay_ms = str(self._link.delay_ms), str(self._link.jitter_ms)
        self._delaying = subprocess.Popen(  # noqa: S603 - our own module
            _command(self._router, *module, *delay_ms)
        )
        end_s = time.monotonic() + _READY_S
        while DELAY_DEVICE not in self._on_router("ip", "-brief", "link", "show", "up"):
            if time.monotonic() > end_s or self._delaying.poll() is not None:
                raise UserError("packets cannot be delayed; is there /dev/net/tun?")
            time.sleep(0.02)
        self._on_router("ip", "route", "add", "default", "dev", DELAY_DEVICE, "table", "77")
        for host in self._addresses:
            self._on_router("ip", "rule", "add", "iif", host, "table", "77")

    def _rule(self, rule: str, *, chain: str) -> None:
        self._on_router("nft", f"add rule inet network {chain} {rule}")

    def _on_router(self, *command: str) -> str:
        return _call(*_command(self._router, *command))

    def _namespace(self, host: str) -> str:
        return f"{self._name}-{host}"


def _command(namespace: str, *command: str) -> list[str]:
    """Return the command that runs another one in a namespace.

    As 'ip netns exec', which does not run below another root directory.
    """
    return ["nsenter", f"--net=/run/netns/{namespace}", *command]


def _call(*command: str) -> str:
    """Run a command and return what it prints.

    Raises
    ------
    UserError
        With what it says, if it fails.
    """
    result = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if result.returncode != 0:
        raise UserError(f"{' '.join(command)}: {result.stderr.strip()}")
    return result.stdout


@contextlib.contextmanager
def _in(namespace: str) -> Iterator[None]:
    with Path("/proc/thread-self/ns/net").open() as own:
        with Path("/run/netns", namespace).open() as other:
            _enter(other.fileno())
        try:
            yield
        finally:
            _enter(own.fileno())


def _enter(namespace: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, _CLONE_NEWNET) != 0:
        raise UserError(f"a network namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
