"""The thread that does a client's I/O."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from kouxing_client.core import ClientCore, forward_errors, map_future
from kouxing_client.errors import KouxingError
from kouxing_client.inbox import new_future
from kouxing_client.keys import Key
from kouxing_client.session_core import SessionCore
from kouxing_client.sockets import Sockets

TICK_S = 0.05
BUSY_TICK_S = 0.005  # interval of ticks while a socket accepts no more audio
T = TypeVar("T")


class ClientThread:
    """Runs a ``ClientCore``; any thread may use it.

    Parameters
    ----------
    control
        Address of control; its public key may follow after a space.
    key
        The key of this program; None if nothing is encrypted.
    timeout_s
        Time limit for an answer.
    start_s
        Time for control to start: how long a request waits if nothing listens at its address.

    Raises
    ------
    KouxingError
        If the address is invalid.
    """

    def __init__(self, control: str, key: Key | None, timeout_s: float, start_s: float) -> None:
        if key is not None and " " not in control:
            control = f"{control} {key.control}"
        self.timeout_s = timeout_s
        self._sockets = Sockets(key)
        self._tick_s = 0.0
        self._is_stopping = False
        self._has_ended = False  # from now on, the calling threads run functions themselves
        try:
            self.core = ClientCore(self._sockets, control, timeout_s, start_s)
        except KouxingError:
            self._sockets.close()
            raise
        self._thread = threading.Thread(target=self._run, name="kouxing-client", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the client is neither closed nor failed."""
        return self._thread.is_alive()

    def call(self, function: Callable[[], None]) -> None:
        """Let the thread call a function soon."""
        self._sockets.call(function)
        if self._has_ended:
            self._sockets.run_calls()

    def check_may_wait(self) -> None:
        """Raise ``KouxingError`` in ``on_result``, where the thread would wait for itself."""
        if threading.current_thread() is self._thread:
            raise KouxingError(
                "on_result cannot call a method that waits for an answer; call it in another thread"
            )

    def submit(
        self, function: Callable[[ClientCore], Future[T]], *, may_wait: bool = True
    ) -> Future[T]:
        """Let the thread call a function; return the future that this function returns.

        ``may_wait``: the caller may wait for the future.
        """
        if may_wait:
            self.check_may_wait()
        if not self.is_running:
            raise KouxingError("the client is closed")
        answer = new_future()

        def run() -> None:
            with forward_errors(answer):  # such as a field that cannot be encoded
                map_future(function(self.core), lambda result: result, answer)

        self.call(run)
        return answer

    def disconnect(self, session: SessionCore) -> Future[None]:
        """Close all connections of a session."""
        closed = new_future()

        def end() -> None:
            session.end(None)
            closed.set_result(None)

        self.call(end)
        return closed

    def close(self) -> None:
        """End the thread and close all connections."""

        def stop() -> None:
            self._is_stopping = True

        self._sockets.call(stop)
        self._thread.join()

    def _run(self) -> None:
        failure = KouxingError("the client is closed")
        try:
            while not self._is_stopping:
                self._step()
        except Exception as error:
            failure = KouxingError(f"the client failed: {error!r}")  # no thread may wait forever
            failure.__cause__ = error
            raise
        finally:
            self.core.close(failure)
            self._sockets.close()
            self._has_ended = True
            self._sockets.run_calls()

    def _step(self) -> None:
        is_busy = any(session.is_blocked for session in self.core.sessions)
        period_s = BUSY_TICK_S if is_busy else TICK_S
        now_s = self._sockets.now_s
        self._tick_s = min(self._tick_s, now_s + period_s)
        self._sockets.step(max(0.0, self._tick_s - now_s))
        if (now_s := self._sockets.now_s) >= self._tick_s:
            self._tick_s = now_s + period_s
            self.core.tick()
