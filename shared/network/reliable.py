"""A message stream from recognizer to synthesizer that survives reconnections.

Messages have sequence numbers, and the receiver acknowledges them cumulatively. The sender keeps
unacknowledged messages, because ZeroMQ drops messages in flight when a peer disconnects.
"""

import math
from collections import deque
from collections.abc import Callable
from itertools import islice

from kouxing_client.messages import Message

from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.wire.events import batch_messages
from kouxing.shared.wire.speech import MAX_BATCHED_MESSAGES, Acknowledge, Progress

RESEND_AFTER_S = 0.5
MAX_RESENT = 200  # messages resent at a time; more would delay a busy receiver further
ACKNOWLEDGE_EVERY_MESSAGES = 32  # a tick acknowledges the rest
ACKNOWLEDGE_INTERVAL_S = 0.05  # minimum time between acknowledgements by ``tick``
MAX_UNACKNOWLEDGED_S = 0.1  # limit; usually, another message causes an earlier tick


class ReliableSender:
    """The sending end for one session."""

    def __init__(self, socket: Socket, session: str, epoch: int) -> None:
        self.socket = socket
        self.session = session
        self.epoch = epoch
        self.acknowledged = 0  # the highest acknowledged number
        self._next = 1
        self.unacknowledged: deque[Message] = deque()  # oldest first; the owner limits their number
        self._waiting: list[Message] = []  # messages to send together
        self._progress_s = 0.0

    def send(self, message: Message, now_s: float) -> None:
        """Send a message with the next number.

        Results are sent with the next ``progress``: the synthesizer makes no frame before it.
        """
        numbered = replace(message, session=self.session, epoch=self.epoch, sequence=self._next)
        self._next += 1
        if not self.unacknowledged:
            self._progress_s = now_s
        self.unacknowledged.append(numbered)
        self._waiting.append(numbered)
        if isinstance(message, Progress) or len(self._waiting) == MAX_BATCHED_MESSAGES:
            self.flush()

    def flush(self) -> None:
        """Send the waiting messages."""
        if self._waiting:
            self.socket.send(batch_messages(self._waiting))
            self._waiting.clear()

    def acknowledge(self, up_to: int, now_s: float) -> list[Message]:
        """Drop the acknowledged messages up to a number; return them."""
        self.acknowledged = max(self.acknowledged, up_to)
        acknowledged = []
        while self.unacknowledged and self.unacknowledged[0].sequence <= up_to:
            acknowledged.append(self.unacknowledged.popleft())
            self._progress_s = now_s
        return acknowledged

    def tick(self, now_s: float) -> int:
        """Resend messages if acknowledgements have stopped; return how many were resent."""
        if not self.unacknowledged or now_s - self._progress_s < RESEND_AFTER_S:
            return 0
        self._progress_s = now_s
        oldest = list(islice(self.unacknowledged, MAX_RESENT))
        for begin in range(0, len(oldest), MAX_BATCHED_MESSAGES):
            self.socket.send(batch_messages(oldest[begin : begin + MAX_BATCHED_MESSAGES]))
        return len(oldest)


class ReliableReceiver:
    """The receiving end for one session: delivers each message once and in order.

    The receiver sets session, epoch and sequence number of what ``make_acknowledgement`` returns.
    """

    def __init__(
        self, socket: Socket, session: str, make_acknowledgement: Callable[[], Acknowledge]
    ) -> None:
        self._socket = socket
        self._session = session
        self._make_acknowledgement = make_acknowledgement
        self._epoch = -1
        self._last = 0
        self._acknowledged = 0
        self._acknowledged_s = -math.inf
        self._peer = NO_PEER

    def receive(self, message: Message, sender: Peer) -> bool:
        """Return whether a message is the next one. The caller must drop all others.

        Every epoch starts with the number 1.
        """
        if message.epoch < self._epoch:
            return False
        self._peer = sender
        if message.epoch > self._epoch:
            self._epoch = message.epoch
            self._last = self._acknowledged = 0
        if message.sequence != self._last + 1:
            self.acknowledge()  # reports which messages are missing
            return False
        self._last = message.sequence
        if self._last - self._acknowledged >= ACKNOWLEDGE_EVERY_MESSAGES:
            self.acknowledge()
        return True

    def tick(self, now_s: float) -> float:
        """Acknowledge newly received messages, if this is due.

        Returns the time of the next call, unless another message arrives earlier.
        """
        if self._last == self._acknowledged:
            return math.inf
        if now_s < self._acknowledged_s + ACKNOWLEDGE_INTERVAL_S:
            return self._acknowledged_s + MAX_UNACKNOWLEDGED_S
        self._acknowledged_s = now_s
        self.acknowledge()
        return math.inf

    def acknowledge(self) -> None:
        """Send an acknowledgement to the sender of the last message, if there was a message."""
        if self._peer is NO_PEER:
            return
        self._acknowledged = self._last
        answer = replace(
            self._make_acknowledgement(),
            session=self._session,
            epoch=self._epoch,
            sequence=self._last,
        )
        self._socket.send(answer, to=self._peer)
