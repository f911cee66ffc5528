"""Results of one session, through its moves and reconnections."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping

import zmq

from kouxing_client.errors import KouxingError
from kouxing_client.following import Order
from kouxing_client.messages import (
    PUBLISHER_OF,
    FapFrame,
    Result,
    Shapes,
    decode,
    kinds_of,
    result,
    topic,
)
from kouxing_client.sockets import Sockets, new_future

KEPT_S = 3.0  # a connection that may be dead, for what TCP still brings
MAX_LIVE = 100  # results of a live session that wait for a program that does not take them
CATCH_UP_S = 0.1  # after this process was stopped, within which all comes that waited
MAX_OLD = 8  # live frames and shapes of these that are taken
LIVE_BUFFER = 65_536  # bytes of the kernel: some seconds of FAP frames, over any distance


class Subscription:
    """Results of one session, in the order in which they arrive.

    ``has_results``, ``take``, ``is_over``, ``failure``, ``joined`` and ``signal`` are for any
    thread.

    Parameters
    ----------
    sockets
        The client's.
    session
        Name of the session.
    epoch
        The session's; 0 if unknown.
    classes
        Results that are wanted.
    shape_set
        Name of the blend shapes, if these are wanted.
    is_live
        Whether results are worth nothing when they are late.
    """

    def __init__(
        self,
        sockets: Sockets,
        session: str,
        epoch: int,
        classes: tuple[type[Result], ...],
        shape_set: str,
        *,
        is_live: bool,
    ) -> None:
        self.signal = sockets.make_signal()
        self.joined = new_future()  # no later result is missed
        self.is_complete = False
        self.failure: KouxingError | None = None
        self.is_over = False  # no more results come than are there
        self._sockets = sockets
        self._session = session
        self._shape_set = shape_set
        self._is_live = is_live
        self._kinds = kinds_of(classes)
        self._order = Order(epoch)
        self._results: deque[Result] = deque(maxlen=MAX_LIVE if is_live else None)
        self._waiting: deque[Result] = deque(maxlen=MAX_OLD)
        self._raw: zmq.Socket[bytes] | None = None
        self._before: zmq.Socket[bytes] | None = None  # until the new one is complete, or longer
        self._leave_s = 0.0  # when it is left; 0: not yet
        self._addresses: set[str] = set()
        self._stays = False  # it subscribed again at the same addresses
        self._confirmed: set[str] = set()  # publishers where the new connection is in effect

    @property
    def has_results(self) -> bool:
        """Whether some wait to be taken."""
        return bool(self._results)

    def take(self) -> Result | None:
        """Return the next result, None if none is there."""
        return self._results.popleft() if self._results else None

    def start(self, endpoints: Mapping[str, str]) -> None:
        """Subscribe where the session is published now, ``phones`` and ``faps``."""
        self._leave_before()
        addresses = {endpoints[PUBLISHER_OF[kind]] for kind in self._kinds}
        self._stays = addresses == self._addresses
        self._addresses, self.is_complete, self._before = addresses, False, self._raw
        self._leave_s = 0.0
        if self._before is not None:
            self._order.follow_anew()
        confirmed: set[str] = set()
        self._confirmed = confirmed
        raw = self._raw = self._sockets.connect(
            zmq.SUB,
            sorted(addresses),
            lambda parts: self._on_message(parts, confirmed),
            buffer=LIVE_BUFFER if self._is_live else -1,
        )
        for kind in (*self._kinds, "joined"):  # joined last
            raw.setsockopt(zmq.SUBSCRIBE, topic(kind, self._session))

    def leave_if_due(self, now_s: float) -> None:
        """Close the connection before this one, once it can bring nothing more."""
        if self._leave_s and now_s >= self._leave_s:
            self._leave_before()

    def end(self, failure: KouxingError | None) -> None:
        """Bring nothing more; with a failure the session is no more."""
        self._leave_before()
        if self._raw is not None:
            self._sockets.drain(self._raw)
        if self._raw is not None:
            self._sockets.drop(self._raw)
            self._raw = None
        self.failure = self.failure or failure
        self.is_over = True
        if not self.joined.done():
            self.joined.set_exception(failure or KouxingError("nobody wants the results"))
        self.signal.notify()

    def _leave_before(self) -> None:
        if self._before is not None:
            self._sockets.drain(self._before)
            self._sockets.drop(self._before)
            self._before, self._leave_s = None, 0.0
            self._order.left_before()

    def _on_message(self, parts: list[bytes], confirmed: set[str]) -> None:
        if (message := decode(parts)) is None:
            return
        kind, fields = message
        if kind == "joined":
            confirmed.add(fields["publisher"])
            self._note_joined()
        elif kind in self._kinds and self._order.takes(kind, fields):
            if self._order.has_ended:
                self._take_waiting()
                self.is_over = True
            elif fields.get("set", self._shape_set) == self._shape_set:
                found = result(kind, fields)
                if found is not None:
                    self._add(found)
            self.signal.notify()

    def _add(self, found: Result) -> None:
        is_catching_up = time.monotonic() < self._sockets.went_on_s + CATCH_UP_S
        if self._is_live and is_catching_up and isinstance(found, FapFrame | Shapes):
            self._waiting.append(found)
            return
        self._take_waiting()
        self._results.append(found)

    def _take_waiting(self) -> None:
        self._results += self._waiting
        self._waiting.clear()

    def _note_joined(self) -> None:
        if not self.is_complete and len(self._confirmed) >= len(self._addresses):
            self.is_complete = True
            self._leave_s = time.monotonic() + (KEPT_S if self._stays else 0.0)
            if not self.joined.done():
                self.joined.set_result(None)
