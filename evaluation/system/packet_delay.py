"""Delays packets: returns each packet that is routed to a TUN device later, in order.

usage: python -m kouxing.evaluation.system.packet_delay DEVICE DELAY_MS JITTER_MS
"""

import fcntl
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections import deque

MAX_PACKET_BYTES = 65_535
_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 0x0001, 0x1000


def main(device: str, delay_s: float, jitter_s: float) -> None:
    """Run until the process is killed."""
    tun = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH22x", device.encode(), _IFF_TUN | _IFF_NO_PI))
    subprocess.run(["ip", "link", "set", device, "up"], check=True)  # noqa: S603, S607
    rng = random.Random(0)  # noqa: S311 - no secret
    queue: deque[tuple[float, bytes]] = deque()  # due time, packet
    due_s = 0.0
    while True:
        remaining_s = max(0.0, queue[0][0] - time.monotonic()) if queue else None
        if select.select([tun], [], [], remaining_s)[0]:
            packet = os.read(tun, MAX_PACKET_BYTES)
            wait_s = delay_s + rng.uniform(-jitter_s, jitter_s)
            due_s = max(due_s, time.monotonic() + wait_s)
            queue.append((due_s, packet))
        while queue and queue[0][0] <= time.monotonic():
            os.write(tun, queue.popleft()[1])


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]) / 1e3, float(sys.argv[3]) / 1e3)
