"""A stream of messages that survives a reconnect.

Sequence numbers, cumulative acknowledgement, and a queue of messages not acknowledged yet: ZeroMQ
drops messages in flight when a peer goes away, and a high-water mark does not prevent it.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable

from kouxing.shared.bus import Socket
from kouxing.shared.keys import NOBODY, Peer
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import AcknowledgePhones

RESEND_AFTER_S = 0.5
ACKNOWLEDGE_EVERY = 32  # messages; each tick acknowledges the rest


class ReliableSender:
    """The sending end for one session."""

    def __init__(self, socket: Socket, session: str, epoch: int) -> None:
        self._socket = socket
        self._session = session
        self.epoch = epoch
        self._next = 1
        self._waiting: deque[Message] = deque()  # the owner watches its length, the backlog
        self._progress_s = 0.0

    @property
    def waiting(self) -> tuple[Message, ...]:
        """The messages that are not acknowledged yet, oldest first."""
        return tuple(self._waiting)

    @property
    def backlog(self) -> int:
        """Number of messages not acknowledged yet."""
        return len(self._waiting)

    def send(self, message: Message, now_s: float) -> Message:
        """Send a message with the next number; return it as it was sent."""
        numbered = dataclasses.replace(
            message, session=self._session, epoch=self.epoch, sequence=self._next
        )
        self._next += 1
        if not self._waiting:
            self._progress_s = now_s
        self._waiting.append(numbered)
        self._socket.send(numbered)
        return numbered

    def acknowledge(self, up_to: int, now_s: float) -> list[Message]:
        """Forget the messages that the receiver has; return them."""
        known = []
        while self._waiting and self._waiting[0].sequence <= up_to:
            known.append(self._waiting.popleft())
            self._progress_s = now_s
        return known

    def tick(self, now_s: float) -> int:
        """Send the waiting messages again after too long without progress; return their number."""
        if not self._waiting or now_s - self._progress_s < RESEND_AFTER_S:
            return 0
        self._progress_s = now_s
        for message in self._waiting:
            self._socket.send(message)
        return len(self._waiting)


class ReliableReceiver:
    """The receiving end for one session: each message once and in order.

    Parameters
    ----------
    socket
        ROUTER that the messages come through.
    session
        Name of the session.
    answer
        Makes an acknowledgement with what it tells beside the sequence number.
    """

    def __init__(
        self,
        socket: Socket,
        session: str,
        answer: Callable[[], AcknowledgePhones] = AcknowledgePhones,
    ) -> None:
        self._socket = socket
        self._session = session
        self._answer = answer
        self._epoch = -1
        self._last = 0
        self._acknowledged = 0
        self._peer = NOBODY

    def accept(self, message: Message, sender: Peer) -> bool:
        """Return whether this message is the next one; ignore it if not.

        The first message of a greater epoch starts again at whatever number it carries.
        """
        if message.epoch < self._epoch:
            return False
        self._peer = sender
        if message.epoch > self._epoch:
            self._epoch = message.epoch
            self._last = message.sequence - 1
            self._acknowledged = self._last
        if message.sequence != self._last + 1:
            self.acknowledge()  # so that the sender knows which are missing
            return False
        self._last = message.sequence
        if self._last - self._acknowledged >= ACKNOWLEDGE_EVERY:
            self.acknowledge()
        return True

    def tick(self) -> None:
        """Acknowledge messages that came since the last acknowledgement."""
        if self._last > self._acknowledged:
            self.acknowledge()

    def acknowledge(self) -> None:
        """Tell the sender of the last message, if there is one, what has come."""
        if self._peer is NOBODY:
            return
        self._acknowledged = self._last
        acknowledgement = dataclasses.replace(
            self._answer(), session=self._session, epoch=self._epoch, sequence=self._last
        )
        self._socket.send(acknowledgement, to=self._peer)
