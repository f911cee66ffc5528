"""Publishes a session's results, and repeats the first results for late subscribers.

When a session opens or moves, its subscribers need time to connect to the new worker. Results that
are published in the meantime are repeated for each of them. Subscribers ignore repeated messages.
"""

from collections import deque
from collections.abc import Sequence

from kouxing_client.messages import Message

from kouxing.shared.network.sockets import Socket

REPLAY_S = 10.0  # time after the start of a session; connecting is slow on a busy machine
MAX_REPLAYED = 2000  # messages


class ReplayingPublisher:
    """Publishes one session of a worker that starts to serve it at ``now_s``."""

    def __init__(self, publisher: Socket, now_s: float) -> None:
        self._publisher = publisher
        self._end_s = now_s + REPLAY_S
        self._messages: deque[Message] = deque(maxlen=MAX_REPLAYED)

    def send(self, message: Message, now_s: float) -> None:
        """Publish a message."""
        self._publisher.send(message)
        if now_s < self._end_s:
            self._messages.append(message)
        else:
            self._messages.clear()

    def repeated(self, now_s: float) -> Sequence[Message]:
        """Return the messages to publish again for a new subscriber."""
        return self._messages if now_s < self._end_s else ()
