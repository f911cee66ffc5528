"""Connections to targets: the interface, and the implementation for datagrams."""

import asyncio
import errno
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.target import Target, TrackerPortError
from kouxing.services.senders.tracker_input import TrackerInput, open_tracker_input

RETRY_S = 1.0
_ASSUME_LISTENING_AFTER_S = 1.0  # without an error for this time, a program is listening


@dataclass(frozen=True, slots=True)
class Option:
    """An option of a target's address. Without ``choices``, it is any text."""

    default: str = ""
    choices: tuple[str, ...] = ()


Options = Mapping[str, Option]  # by name
COMMON_OPTIONS: Options = {"delay": Option("0"), "only": Option("face", ("face", "mouth"))}


class TargetConnection(ABC):
    """A connection to a target, which reconnects automatically.

    Each protocol is one subclass, listed by ``protocols.protocols``.
    """

    default_port: ClassVar[int]  # default port of the protocol
    options: ClassVar[Options] = COMMON_OPTIONS
    contents: ClassVar[str] = ""  # what a frame contains; empty: the target's shapes

    def __init__(self, target: Target) -> None:
        self.target = target
        self.problem = ""  # why frames do not reach the target, if known

    @abstractmethod
    async def run(self) -> None:
        """Keep the connection open until cancelled, or until the user must act."""

    @abstractmethod
    def send(self, frame: FaceFrame) -> bool:
        """Send a frame immediately; return whether it was sent."""


class DatagramConnection(TargetConnection):
    """A UDP connection. Receipt is not confirmed, but a closed local port is reported."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._socket: socket.socket | None = None
        self._last_error_s = -_ASSUME_LISTENING_AFTER_S
        self._newest_frame: FaceFrame | None = None
        self._tracker_input: tuple[asyncio.DatagramTransport, TrackerInput] | None = None
        self._is_forwarding = False  # whether the tracker's newest packet was sent
        self._tracker_problem = ""  # shown while the target itself has no problem

    @abstractmethod
    def encode(self, frame: FaceFrame) -> Iterable[bytes]:
        """Return the datagrams of a frame."""

    def with_mouth(self, packet: bytes, frame: FaceFrame) -> tuple[Iterable[bytes], bool]:
        """Replace the mouth in a tracker's packet, for protocols with ``camera``.

        Returns the new packets, and whether they contain the mouth. Raises ``ValueError`` if the
        packet is malformed.
        """
        raise NotImplementedError

    async def run(self) -> None:
        """Resolve the host and open sockets; repeat after a network change."""
        try:
            while True:
                if self._socket is None:
                    try:
                        self._socket = await self._open()
                    except TrackerPortError as error:
                        self.problem = str(error)
                    except OSError as error:
                        self.problem = (
                            f"cannot reach {self.target.host}: {error.strerror}; check the address"
                            " and the network"
                        )
                if self._tracker_input is None and self.target.tracker_address is not None:
                    await self._open_tracker_input(*self.target.tracker_address)
                await asyncio.sleep(RETRY_S)
        finally:
            self._close()
            if self._tracker_input is not None:
                self._tracker_input[0].close()

    async def _open_tracker_input(self, host: str, port: int) -> None:
        try:
            self._tracker_input = await open_tracker_input(host, port, self._forward)
            self._tracker_problem = ""
        except OSError as error:
            self._tracker_problem = (
                f"cannot receive from a tracker on {host}:{port}: {error.strerror}; choose another"
                " address or port"
            )

    def _forward(self, packet: bytes) -> bool:
        if self._newest_frame is None:
            return False
        packets, has_mouth = self.with_mouth(packet, self._newest_frame)
        self._is_forwarding = self._send(packets)
        return has_mouth

    def send(self, frame: FaceFrame) -> bool:
        """Send the datagrams of a frame, unless a tracker's packets contain its mouth."""
        self._newest_frame = frame
        if self._tracker_input is not None and self._tracker_input[1].is_live:
            return self._is_forwarding
        return self._send(self.encode(frame))

    def _send(self, datagrams: Iterable[bytes]) -> bool:
        """Send datagrams; drop datagrams that the system does not accept."""
        if self._socket is None:
            return False
        now_s = time.monotonic()
        try:
            for datagram in datagrams:
                self._socket.send(datagram)
        except BlockingIOError:
            return False
        except OSError as error:
            self._last_error_s = now_s
            address = f"{self.target.host}:{self.target.port}"
            if error.errno == errno.ECONNREFUSED:
                self.problem = f"no program is listening on {address}; turn its receiver on"
            else:
                self.problem = (
                    f"cannot reach {address}: {error.strerror}; check the address and the network"
                )
                self._close()
            return False
        if now_s - self._last_error_s < _ASSUME_LISTENING_AFTER_S:
            return False
        self.problem = self._tracker_problem
        return True

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def _open(self) -> socket.socket:
        addresses = await asyncio.get_running_loop().getaddrinfo(
            self.target.host, self.target.port, type=socket.SOCK_DGRAM
        )
        # most receivers listen on IPv4 only, and localhost resolves to both
        family, kind, protocol, _, address = min(
            addresses, key=lambda candidate: candidate[0] != socket.AF_INET
        )
        udp = socket.socket(family, kind, protocol)
        try:
            udp.setblocking(False)
            try:
                udp.connect(address)
                is_this_machine = udp.getsockname()[0] == udp.getpeername()[0]
            except PermissionError:  # a broadcast address, which includes this machine
                udp.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
                udp.connect(address)
                is_this_machine = True
            tracker_address = self.target.tracker_address
            if is_this_machine and tracker_address and tracker_address[1] == self.target.port:
                raise TrackerPortError(self.target.port)  # packets would circulate forever
        except (OSError, TrackerPortError):
            udp.close()
            raise
        return udp
