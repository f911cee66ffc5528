"""Queues a session's messages for the program, and wakes waiting threads or tasks."""

import asyncio
import contextlib
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from kouxing_client.errors import KouxingError, Refused


def new_future() -> Future[Any]:
    """Return a future that the waiting thread cannot cancel."""
    future: Future[Any] = Future()
    future.set_running_or_notify_cancel()
    return future


class Signal:
    """Wakes the threads, and the tasks of any event loop, that wait for a change."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._tasks: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()

    def notify(self) -> None:
        """Report a change; any thread may call this."""
        with self._condition:
            self._condition.notify_all()
            for loop, event in self._tasks:
                with contextlib.suppress(RuntimeError):  # the event loop is closed
                    loop.call_soon_threadsafe(event.set)

    def wait(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Block the thread until a condition holds; return whether it does."""
        with self._condition:
            return self._condition.wait_for(condition, timeout_s)

    async def wait_async(self, condition: Callable[[], bool]) -> None:
        """Wait in a task until a condition holds."""
        if condition():
            return
        event = asyncio.Event()
        task = (asyncio.get_running_loop(), event)
        with self._condition:
            self._tasks.add(task)
        try:
            while not condition():
                await event.wait()
                event.clear()
        finally:
            with self._condition:
                self._tasks.remove(task)


class Inbox:
    """Messages that wait for the program; any thread may use it."""

    def __init__(self, capacity: int | None) -> None:
        self.messages: deque[Any] = deque(maxlen=capacity)
        self.has_ended = False  # no more messages arrive
        self.failure: KouxingError | None = None  # reason for an early end
        self.num_missed = 0  # frames and phones that did not arrive
        self.errors: deque[Refused] = deque()  # errors about the session's audio
        self.signal = Signal()

    def add(self, message: Any) -> None:
        """Add a message."""
        self.messages.append(message)
        self.signal.notify()

    def end(self, failure: KouxingError | None) -> None:
        """Stop accepting messages."""
        self.has_ended, self.failure = True, self.failure or failure
        self.signal.notify()
