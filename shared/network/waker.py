"""Wakes a thread that waits for file descriptors."""

import contextlib
import os
import weakref


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
