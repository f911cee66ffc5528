"""Wakes a thread that waits for file descriptors, such as those that libzmq owns."""

import contextlib
import os
import select
import sys
import weakref

_REPORTS_ARRIVALS = sys.platform == "linux"  # elsewhere, every wait returns immediately


class Waker:
    """A pipe that becomes readable (``descriptor``) when another thread calls ``wake``."""

    def __init__(self) -> None:
        self.descriptor, self._write_end = os.pipe()
        for end in (self.descriptor, self._write_end):
            os.set_blocking(end, False)
            weakref.finalize(self, os.close, end)

    def wake(self) -> None:
        """Make the descriptor readable. Any thread or signal handler may call this."""
        with contextlib.suppress(BlockingIOError):  # already readable
            os.write(self._write_end, b".")

    def clear(self) -> bool:
        """Make the descriptor unreadable again; return whether it was readable."""
        try:
            return bool(os.read(self.descriptor, 4096))
        except BlockingIOError:
            return False


class DescriptorWaiter:
    """Waits until data arrives at one of the added descriptors.

    Only new data ends a wait. Older data does not, even if libzmq has not read it yet. The kernel
    removes closed descriptors.
    """

    def __init__(self) -> None:
        self._waker = Waker()
        self._epoll = select.epoll() if _REPORTS_ARRIVALS else None
        self.add(self._waker.descriptor)

    def add(self, descriptor: int) -> None:
        """Add a descriptor to wait for. Any thread may call this."""
        if self._epoll is not None:
            with contextlib.suppress(OSError):  # closed, or added before
                self._epoll.register(descriptor, select.EPOLLIN | select.EPOLLET)

    def wait(self, timeout_s: float) -> None:
        """Wait until data arrives, up to the timeout."""
        if self._epoll is not None:
            self._epoll.poll(max(0.0, timeout_s))

    def close(self) -> None:
        """End the wait of another thread."""
        self._waker.wake()
