"""Follows the messages of one session through moves and reconnections, without I/O."""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Protocol

from kouxing_client.errors import KouxingError
from kouxing_client.messages import EndOfFaps, FapFrame, Joined, Message

RETRY_S = 3.0  # an unconfirmed subscription is made again after this time
OVERLAP_S = 3.0  # time for which a possibly dead connection stays open for late data
CATCH_UP_S = 0.1  # queued messages arrive within this time after a suspension
MAX_HELD_FRAMES = 8  # number of these live frames that are kept
_Number = tuple[int, int]  # epoch and sequence, or media time and sequence
_NO_NUMBER = (-1, -1)


class Transport(Protocol):
    """The sockets and the clock that a follower uses. A connection is any object."""

    @property
    def now_s(self) -> float:
        """Monotonic time."""

    @property
    def resumed_at_s(self) -> float:
        """When this process last resumed after a suspension; minus infinity before the first."""

    def subscribe(
        self,
        session: str,
        classes: Collection[type[Message]],
        addresses: Collection[str],
        live_addresses: Collection[str],
        on_message: Callable[[Any], None],
    ) -> object:
        """Connect and subscribe to classes of messages of a session, in order.

        The kernel buffers only a little of what ``live_addresses`` publish.
        """

    def drain(self, connection: Any) -> None:
        """Pass on the messages that have arrived, until the connection is closed."""

    def close_connection(self, connection: Any) -> None:
        """Close a connection."""


class Follower:
    """Receives chosen classes of messages of one session, in order and each message once.

    After a move, the old connection stays open until the new subscriptions are in effect, and
    ``OVERLAP_S`` longer if one of the publishers stays the same. If a publisher does not confirm,
    the follower subscribes again: libzmq never reconnects a socket to an address where another
    program answered before. Messages that arrive before their publisher confirms wait until then,
    because the publisher may repeat them in order, after older ones.

    Parameters
    ----------
    classes
        Classes of messages to subscribe to.
    is_paced
        Whether the session's audio arrives in real time, so that late frames are worthless. If so,
        and this process was stalled, only the newest ``MAX_HELD_FRAMES`` of the queued frames are
        delivered.
    on_complete
        Called when every publisher has confirmed: no later message is missed. Called again after
        each ``start``.
    on_new_epoch
        Called when the session continues in a new epoch, before the first message of that epoch.
    """

    def __init__(
        self,
        transport: Transport,
        session: str,
        classes: Collection[type[Message]],
        on_message: Callable[[Any], None],
        *,
        is_paced: bool = True,
        on_complete: Callable[[], None] = lambda: None,
        on_new_epoch: Callable[[], None] = lambda: None,
    ) -> None:
        self.session = session
        self.epoch = 0  # highest epoch of any message or of the first start; 0 if unknown
        self.is_complete = False  # every publisher has confirmed
        self.has_ended = False  # the last FAP frame has arrived; needs EndOfFaps in the classes
        self.num_missed = 0  # FAP frames, by gaps in their sequence numbers
        self.num_outdated = 0  # messages that were dropped because their epoch has ended
        self.received_at_s = transport.now_s  # time of the last message or confirmation
        self._transport = transport
        self._classes = classes
        self._on_message = on_message
        self._is_paced = is_paced
        self._on_complete = on_complete
        self._on_new_epoch = on_new_epoch
        self._connection: object | None = None
        self._old_connection: object | None = None  # open until the new one is complete
        self._close_old_due_s = math.inf
        self._retry_s = math.inf
        self._addresses: set[str] = set()
        self._live_addresses: set[str] = set()
        self._keeps_publisher = False  # an address was also used before the move
        self._confirmed: set[str] = set()  # publishers
        # Messages that arrived before the confirmation, by endpoints that have not confirmed
        self._early: dict[str, list[Message]] = {}
        self._first_epoch = 0
        self._epochs: dict[str, int] = {}  # endpoint: epoch of its newest message
        self._newest: dict[str, _Number] = {}  # numbers of the newest message, by kind
        self._newest_before: dict[str, _Number] = {}  # newest at the new subscription
        self._seen: set[tuple[str, _Number]] = set()  # messages since the new subscription
        self._last_frame = _NO_NUMBER  # media time and sequence
        self._last_sequence: int | None = None
        self._held_frames: deque[FapFrame] = deque(maxlen=MAX_HELD_FRAMES)

    def start(self, epoch: int, endpoints: Mapping[str, str]) -> None:
        """Subscribe to ``endpoints``; when called again, where the session is published now.

        The first ``epoch`` may be 0 if it is unknown. Messages report later epochs.

        Raises
        ------
        KouxingError
            If an endpoint is missing or malformed.
        """
        self._accept_all_early()
        names = {cls.published_at for cls in self._classes}
        if missing := sorted(names - endpoints.keys()):
            raise KouxingError(f"session {self.session} has no endpoint {missing[0]!r}")
        addresses = {endpoints[name] for name in names}
        keeps_publisher = bool(addresses & self._addresses)
        is_joining = self._old_connection is not None and not self.is_complete
        previous, self._live_addresses = self._connection, set()
        if self._is_paced and "faps" in names:
            self._live_addresses = {endpoints["faps"]}
        self._addresses = addresses
        if is_joining and previous is not None:
            self._transport.close_connection(previous)  # so far, only the old connection works
            self._keeps_publisher = self._keeps_publisher and keeps_publisher
        else:
            self._close_old_connection()
            self._old_connection, self._keeps_publisher = previous, keeps_publisher
            self._newest_before, self._seen = dict(self._newest), set()
        self._close_old_due_s = math.inf
        self._first_epoch = self._first_epoch or epoch
        self.epoch = self.epoch or epoch
        self._subscribe()

    def tick(self) -> float:
        """Resubscribe, close the old connection, or deliver held frames, if due.

        Returns the time of the next call. Also call this after every message.
        """
        now_s = self._transport.now_s
        if self._held_frames and now_s >= self._caught_up_at_s:
            self._deliver_held()
        if now_s >= self._close_old_due_s:
            self._close_old_connection()
        if self._connection is not None and now_s >= self._retry_s:
            self._accept_all_early()
            self._transport.close_connection(self._connection)
            self._subscribe()
        held_until_s = self._caught_up_at_s if self._held_frames else math.inf
        return min(self._close_old_due_s, self._retry_s, held_until_s)

    def drain(self) -> None:
        """Pass on all messages that have arrived."""
        self._close_old_connection()
        if self._connection is not None:
            self._transport.drain(self._connection)
        self._accept_all_early()
        self._deliver_held()

    def await_confirmation(self) -> Any:
        """Wait until every publisher confirms again; return the connection.

        The caller must subscribe to ``joined`` again on this connection.
        """
        self.is_complete = False
        self._confirmed.clear()
        return self._connection

    def close(self) -> None:
        """Unsubscribe; from then on, no message is delivered."""
        for connection in (self._connection, self._old_connection):
            if connection is not None:
                self._transport.close_connection(connection)
        self._connection = self._old_connection = None
        self._held_frames.clear()
        self.is_complete = False
        self._retry_s = self._close_old_due_s = math.inf

    def _subscribe(self) -> None:
        confirmed = self._confirmed = set()
        early = self._early = {cls.published_at: [] for cls in self._classes}
        self.is_complete = False
        self._retry_s = self._transport.now_s + RETRY_S
        self._connection = self._transport.subscribe(
            self.session,
            (*self._classes, Joined),  # subscribed last, so its confirmation covers the others
            self._addresses - self._live_addresses,
            self._live_addresses,
            lambda message: self._on_arrival(message, confirmed, early),
        )

    def _close_old_connection(self) -> None:
        """Process what the old connection has received, and close it."""
        self._close_old_due_s = math.inf
        if (connection := self._old_connection) is None:
            return
        self._transport.drain(connection)
        if self._old_connection is connection:  # no handler has closed the connection
            self._transport.close_connection(connection)
            self._old_connection = None

    def _on_arrival(
        self, message: Message, confirmed: set[str], early: dict[str, list[Message]]
    ) -> None:
        self.received_at_s = self._transport.now_s
        if isinstance(message, Joined):
            endpoints = [*early] if message.endpoint is None else [message.endpoint]
            for endpoint in endpoints:
                messages = early.pop(endpoint, [])
                self._accept_early(() if message.repeats else messages)
            self._on_joined(message.publisher, confirmed)
        elif message.published_at in early:
            early[message.published_at].append(message)
        else:
            self._receive(message)

    def _accept_all_early(self) -> None:
        """Accept the messages of publishers that have not confirmed the newest connection."""
        while self._early:
            self._accept_early(self._early.popitem()[1])

    def _accept_early(self, messages: Iterable[Message]) -> None:
        for message in messages:
            if self._connection is not None:  # no handler has closed it
                self._receive(message)

    @property
    def _caught_up_at_s(self) -> float:
        """Time by which messages queued during the last suspension have arrived."""
        return self._transport.resumed_at_s + CATCH_UP_S

    def _receive(self, message: Message) -> None:
        is_catching_up = self._transport.now_s < self._caught_up_at_s
        if self._is_paced and isinstance(message, FapFrame) and is_catching_up:
            self._held_frames.append(message)
        else:
            self._deliver_held()
            self._accept(message)

    def _deliver_held(self) -> None:
        while self._held_frames:
            self._accept(self._held_frames.popleft())

    def _on_joined(self, publisher: str, confirmed: set[str]) -> None:
        confirmed.add(publisher)
        if confirmed is not self._confirmed or self.is_complete:
            return
        # A publisher that restarted confirms once more, under a new name.
        if len(confirmed) >= len(self._addresses):
            self.is_complete = True
            self._retry_s = math.inf
            self._close_old_due_s = self._transport.now_s + (
                OVERLAP_S if self._keeps_publisher else 0.0
            )
            self.tick()
            self._on_complete()

    def _accept(self, message: Message) -> None:
        known_epoch = self._epochs.get(message.published_at, self._first_epoch)
        is_end = isinstance(message, EndOfFaps)
        if message.epoch < known_epoch or (is_end and message.epoch < self.epoch):
            self.num_outdated += 1
            return
        if message.epoch > self.epoch:
            self._enter_epoch(message.epoch)
        if self._is_repeated(message):
            return
        if isinstance(message, FapFrame):
            if self._last_sequence is not None:
                self.num_missed += max(0, message.sequence - self._last_sequence - 1)
            self._last_sequence = message.sequence
        elif is_end:
            self.has_ended = True
        self._on_message(message)

    def _is_repeated(self, message: Message) -> bool:
        """Return whether the message arrived before, on the other connection or in an epoch."""
        kind, number = message.kind, (message.epoch, message.sequence)
        has_old_connection = self._old_connection is not None
        known = self._newest_before if has_old_connection else self._newest
        is_numbered = message.sequence > 0
        if is_numbered and (number <= known.get(kind, _NO_NUMBER) or (kind, number) in self._seen):
            return True
        if has_old_connection:
            self._seen.add((kind, number))
        self._epochs[message.published_at] = message.epoch
        self._newest[kind] = max(number, self._newest.get(kind, number))
        if isinstance(message, FapFrame):
            number = (message.media_time, message.sequence)
            if number <= self._last_frame:
                return True
            self._last_frame = number
        return False

    def _enter_epoch(self, epoch: int) -> None:
        is_new = self.epoch > 0
        self.epoch = epoch
        if is_new:
            self.has_ended = False
            self._on_new_epoch()
