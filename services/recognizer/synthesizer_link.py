"""A session's messages to its synthesizer.

A new synthesizer in place of a lost one must continue the face. It gets the newest frame that was
published, and the messages of the last seconds again.
"""

from __future__ import annotations

from collections import deque

from kouxing.shared.clock import to_samples
from kouxing.shared.reliable import ReliableSender
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import Acknowledge, NewestFrame, Progress, Speech

KEPT = to_samples(3.0)  # media time of the messages that a new synthesizer gets, samples


class SynthesizerLink:
    """Sends to the session's current synthesizer, and keeps what a new one needs."""

    def __init__(self) -> None:
        self._sender: ReliableSender | None = None
        self._kept: deque[Message] = deque()  # acknowledged messages of the last KEPT samples
        self._speech: Speech | None = None  # the newest one before those
        self._newest_frame: NewestFrame | None = None  # that the synthesizer has published

    @property
    def backlog(self) -> int:
        """Number of messages that are not acknowledged yet."""
        return len(self._sender.unacknowledged) if self._sender is not None else 0

    def connect(self, socket: Socket, session: str, epoch: int, now_s: float) -> None:
        """Send to this synthesizer from now on, first what a new one needs."""
        messages = [*self._kept, *(self._sender.unacknowledged if self._sender is not None else ())]
        self._kept.clear()
        self._sender = ReliableSender(socket, session, epoch)
        if (frame := self._newest_frame) is not None:
            self._sender.send(Progress(media_time=frame.media_time, newest_frame=frame), now_s)
        if self._speech is not None:
            self._sender.send(self._speech, now_s)
        for message in messages:
            if not _is_resumption(message):
                self._sender.send(message, now_s)

    def disconnect(self) -> None:
        """Stop sending."""
        self._sender = None
        self.forget()

    def send(self, message: Message, now_s: float) -> None:
        """Send a message, if there is a synthesizer."""
        if self._sender is not None:
            self._sender.send(message, now_s)

    def acknowledge(self, ack: Acknowledge, now_s: float) -> list[Message]:
        """Return the results that the synthesizer has newly acknowledged."""
        if self._sender is None or ack.epoch != self._sender.epoch:
            return []
        self._newest_frame = ack.newest_frame or self._newest_frame
        acknowledged = self._sender.acknowledge(ack.sequence, now_s)
        messages = [message for message in acknowledged if not _is_resumption(message)]
        self._kept.extend(messages)
        while self._kept and self._kept[0].media_time < self._kept[-1].media_time - KEPT:
            oldest = self._kept.popleft()
            if isinstance(oldest, Speech):
                self._speech = oldest
        return messages

    def forget(self) -> None:
        """Forget all messages before an interruption."""
        self._kept.clear()
        self._speech = None

    def tick(self, now_s: float) -> int:
        """Resend messages that were not acknowledged in time; return their number."""
        return self._sender.tick(now_s) if self._sender is not None else 0


def _is_resumption(message: Message) -> bool:
    """Return whether a message only has the frame after which a new synthesizer continues."""
    return isinstance(message, Progress) and message.newest_frame is not None
