"""A session's messages to its synthesizer, and the sockets to synthesizers.

A synthesizer that replaces a lost one must continue the face. It receives the newest published
frame, and the messages of the last seconds again.
"""

from collections import deque
from collections.abc import Set as AbstractSet

from kouxing_client.messages import Message, Phone, Speech

from kouxing.shared.clock import to_samples
from kouxing.shared.network.reliable import ReliableSender
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.message_loop import Handler, MessageLoop
from kouxing.shared.wire.events import is_state_report
from kouxing.shared.wire.speech import Acknowledge, LipPositions, NewestFrame, Progress

MAX_BACKLOG = 2000  # unacknowledged messages above which audio waits
MAX_OVERDUE_S = 5.0  # then new messages are dropped, so that other sessions continue
KEPT_SAMPLES = to_samples(3.0)  # media time of the messages kept for a new synthesizer, samples


class SynthesizerLink:
    """Sends to the session's current synthesizer, and keeps messages for a replacement."""

    def __init__(self) -> None:
        self._sender: ReliableSender | None = None
        self._acknowledged: deque[Message] = deque()  # messages of the last KEPT_SAMPLES
        self._speech: Speech | None = None  # the newest Speech before these messages
        self._interrupted_sequence = 0  # number of the last message before an interruption
        self._newest_frame: NewestFrame | None = None  # published by the synthesizer
        self._full_since_s: float | None = None
        self._is_dropping = False

    @property
    def backlog(self) -> int:
        """Number of messages that are not acknowledged yet."""
        return len(self._sender.unacknowledged) if self._sender is not None else 0

    def connect(self, socket: Socket, session: str, epoch: int, now_s: float) -> None:
        """Switch to this synthesizer. First send the newest frame and the kept messages."""
        messages = [
            *self._acknowledged,
            *filter(self._is_needed, self._sender.unacknowledged if self._sender else ()),
        ]
        self._acknowledged.clear()
        self._interrupted_sequence = 0
        self._full_since_s, self._is_dropping = None, False
        self._sender = ReliableSender(socket, session, epoch)
        if (frame := self._newest_frame) is not None:
            self._sender.send(Progress(media_time=frame.media_time, newest_frame=frame), now_s)
        if self._speech is not None:
            self._sender.send(self._speech, now_s)
        for message in messages:
            if not is_state_report(message):
                self._sender.send(message, now_s)
        self._sender.flush()

    @property
    def is_full(self) -> bool:
        """Whether the backlog is too long to accept more audio."""
        return self.backlog > MAX_BACKLOG and not self._is_dropping

    def check_overdue(self, now_s: float) -> bool:
        """Return whether the link starts to drop messages. It stops when all are acknowledged."""
        if self.backlog <= MAX_BACKLOG:
            self._full_since_s = None
            self._is_dropping = self._is_dropping and self.backlog > 0
            return False
        if self._full_since_s is None:
            self._full_since_s = now_s
        if self._is_dropping or now_s - self._full_since_s <= MAX_OVERDUE_S:
            return False
        self._is_dropping = True
        return True

    def send(self, message: Message, now_s: float) -> None:
        """Send a message, if there is a synthesizer and the link is not dropping messages."""
        if self._sender is not None and not self._is_dropping:
            self._sender.send(message, now_s)

    def acknowledge(self, ack: Acknowledge, now_s: float) -> list[Message]:
        """Return the results that the synthesizer has newly acknowledged."""
        if self._sender is None or ack.epoch != self._sender.epoch:
            return []
        if ack.sequence == 0 < self._sender.acknowledged:  # it restarted, and waits for number 1
            self.connect(self._sender.socket, self._sender.session, ack.epoch, now_s)
            return []
        self._newest_frame = ack.newest_frame or self._newest_frame
        acknowledged = self._sender.acknowledge(ack.sequence, now_s)
        messages = [message for message in acknowledged if not is_state_report(message)]
        self._acknowledged.extend(filter(self._is_needed, messages))
        while (
            self._acknowledged
            and self._acknowledged[0].media_time < self._acknowledged[-1].media_time - KEPT_SAMPLES
        ):
            oldest = self._acknowledged.popleft()
            if isinstance(oldest, Speech):
                self._speech = oldest
        return messages

    def forget(self) -> None:
        """Forget all messages before an interruption."""
        self._acknowledged.clear()
        self._speech = None
        if self._sender is not None and self._sender.unacknowledged:
            self._interrupted_sequence = self._sender.unacknowledged[-1].sequence

    def _is_needed(self, message: Message) -> bool:
        """Return whether a new synthesizer needs a message: no speech before an interruption."""
        is_speech = isinstance(message, Phone | LipPositions)
        return not is_speech or message.sequence > self._interrupted_sequence

    def tick(self, now_s: float) -> int:
        """Resend messages that were not acknowledged in time; return their number."""
        return self._sender.tick(now_s) if self._sender is not None else 0


class SynthesizerSockets:
    """One socket for each synthesizer. The loop passes its messages to the handlers."""

    def __init__(self, loop: MessageLoop, handlers: dict[type[Message], Handler]) -> None:
        self._loop = loop
        self._handlers = handlers
        self._sockets: dict[str, Socket] = {}  # by endpoint

    def connect(self, endpoint: str) -> Socket:
        """Return the socket of an endpoint."""
        if endpoint not in self._sockets:
            socket = self._loop.bus.connect_dealer(endpoint)
            self._sockets[endpoint] = socket
            # While there are sessions, the loop runs often enough for acknowledgements.
            self._loop.register(socket, self._handlers, is_quiet=True)
        return self._sockets[endpoint]

    def close_unused(self, used: AbstractSet[str]) -> None:
        """Close the sockets of all other endpoints."""
        for endpoint in self._sockets.keys() - used:
            self._loop.unregister(self._sockets.pop(endpoint))
