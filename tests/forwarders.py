"""Hosts without network namespaces: loopback addresses, and what others send to them is passed on.

A link that is cut holds what it has, as one does whose packets are sent again later.
"""

from __future__ import annotations

import contextlib
import itertools
import secrets
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Self

from kouxing.evaluation.system.network import Network
from kouxing.evaluation.system.systems import PORTS
from kouxing.shared.keys import CLIENT

ALL_PORTS = sorted(port for ports in PORTS.values() for port in ports.values())
BETWEEN_SERVICES = PORTS["synthesizer"]["phone_input"]


@dataclass
class Link:
    """What connects to a port of a host from another one."""

    hosts: tuple[str, ...]
    listener: socket.socket
    target: tuple[str, int]
    is_open: threading.Event = field(default_factory=threading.Event)
    ends: list[socket.socket] = field(default_factory=list)
    threads: list[threading.Thread] = field(default_factory=list)

    def start(self) -> None:
        self.is_open.set()
        self._in_thread(self._accept)

    def close(self) -> None:
        self.is_open.set()
        for each in (self.listener, *self.ends):
            _end(each)
        for thread in self.threads:
            thread.join()
        self.listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # closed
            while True:
                incoming, _ = self.listener.accept()
                self._in_thread(self._join, incoming, socket.socket())

    def _join(self, incoming: socket.socket, outgoing: socket.socket) -> None:
        self.ends += [incoming, outgoing]
        with incoming, outgoing, contextlib.suppress(OSError):  # one end is gone
            self.is_open.wait()
            outgoing.connect(self.target)
            back = self._in_thread(self._pass_on, outgoing, incoming)
            self._pass_on(incoming, outgoing)
            back.join()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self.is_open.wait()
                sink.sendall(data)
        _end(source)
        _end(sink)

    def _in_thread(self, work: Callable[..., None], *ends: socket.socket) -> threading.Thread:
        thread = threading.Thread(target=work, args=ends, daemon=True)
        self.threads.append(thread)
        thread.start()
        return thread


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # ended already
        connection.shutdown(socket.SHUT_RDWR)


class Forwarders(Network):
    """Hosts that forwarders join instead of a router."""

    def __init__(self, hosts: Sequence[str]) -> None:
        net = f"127.{secrets.randbelow(250) + 2}.{secrets.randbelow(250) + 2}"
        numbers = itertools.count(1)
        self._bound = {host: f"{net}.{next(numbers)}" for host in hosts}
        self._seen = {
            (host, viewer): f"{net}.{next(numbers)}"
            for host in hosts
            for viewer in hosts
            if viewer != host and (viewer == CLIENT or host == "control")
        }
        self._links: list[Link] = []

    def __enter__(self) -> Self:
        for (host, viewer), address in self._seen.items():
            for port in ALL_PORTS:
                crossed = (host,) if port == BETWEEN_SERVICES else (host, viewer)
                target = self._bound[host], port
                link = Link(crossed, socket.create_server((address, port)), target)
                self._links.append(link)
                link.start()
        return self

    def __exit__(self, *_: object) -> None:
        for link in self._links:
            link.close()

    def bound(self, host: str) -> str:
        return self._bound[host]

    def address(self, host: str, seen_from: str) -> str:
        return self._seen.get((host, seen_from), self._bound[host])

    def command(self, host: str, *command: str) -> list[str]:
        del host
        return [*command]

    def on(self, host: str) -> contextlib.AbstractContextManager[None]:
        del host
        return contextlib.nullcontext()

    def cut(self, host: str) -> None:
        for link in self._links:
            if host in link.hosts:
                link.is_open.clear()

    def mend(self) -> None:
        for link in self._links:
            link.is_open.set()
