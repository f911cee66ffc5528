"""Holds connections open after libzmq has closed them, so that peers do not reconnect immediately.

A ZeroMQ peer reconnects 0.1 s after its connection has ended. Each handshake costs this process
0.5 ms, so a thousand extra peers would delay the messages of all other peers.
"""

import math
import socket
from collections import deque

from kouxing.shared.network import kernel_sockets

MAX_HELD_CONNECTIONS = 1600
HOLD_S = 2.0  # minimum time
GAP_S = 0.005  # interval between resets; peers that are reset together reconnect together


class Tarpit:
    """Holds up to ``capacity`` connections, and later resets them one by one."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._held: deque[tuple[float, socket.socket]] = deque()  # with the time of the reset

    def add(self, descriptor: int, inode: int, now_s: float) -> None:
        """Hold a connection. libzmq then closes it, unless the peer keeps sending."""
        held = kernel_sockets.hold(descriptor, inode)
        if held is not None:
            last_s = self._held[-1][0] if self._held else 0.0
            self._held.append((max(now_s + HOLD_S, last_s + GAP_S), held))

    def release(self, now_s: float) -> None:
        """Reset the connections that are due, and the oldest ones above the capacity."""
        while self._held and (self._held[0][0] <= now_s or len(self._held) > self._capacity):
            self._held.popleft()[1].close()

    def close(self) -> None:
        """Reset all connections."""
        self.release(math.inf)
