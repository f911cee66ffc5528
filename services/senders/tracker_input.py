"""Forwards the packets of a camera tracker, with the mouth of the session.

A tracker such as VSeeFace, or Live Link Face on an iPhone, sends its packets to a port of this
machine instead of the program with the avatar. Each packet is forwarded on arrival. The mouth of
the session's newest frame replaces its mouth; all other values stay unchanged. While the tracker
sends, the session's own frames are not sent. Malformed packets are dropped.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable

_LIVE_S = 1.0  # after this time without a packet, the tracker is considered stopped
_MAX_RATE_HZ = 600  # packets above this rate are dropped unread


class TrackerInput(asyncio.DatagramProtocol):
    """Receives a tracker's packets and passes them to ``forward``.

    ``forward`` returns whether the packet contained a mouth, and raises ``ValueError`` if the
    packet is malformed.
    """

    def __init__(self, forward: Callable[[bytes], bool]) -> None:
        self._forward = forward
        self._loop = asyncio.get_running_loop()
        self._last_face_s = -math.inf
        self._window_start_s, self._num_in_window = -math.inf, 0

    @property
    def is_live(self) -> bool:
        """Whether the tracker sends faces."""
        return self._loop.time() - self._last_face_s < _LIVE_S

    def datagram_received(self, data: bytes, _address: object) -> None:
        """Forward a packet."""
        now_s = self._loop.time()
        if now_s - self._window_start_s >= 1.0:
            self._window_start_s, self._num_in_window = now_s, 0
        self._num_in_window += 1
        if self._num_in_window > _MAX_RATE_HZ:
            return
        with contextlib.suppress(ValueError):
            if self._forward(data):
                self._last_face_s = now_s


async def open_tracker_input(
    host: str, port: int, forward: Callable[[bytes], bool]
) -> tuple[asyncio.DatagramTransport, TrackerInput]:
    """Receive the packets of a tracker; raises ``OSError`` if the port is not free."""
    loop = asyncio.get_running_loop()
    return await loop.create_datagram_endpoint(
        lambda: TrackerInput(forward), local_addr=(host, port)
    )
