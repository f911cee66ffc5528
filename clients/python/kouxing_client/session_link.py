"""One session as the client's thread sees it."""

from __future__ import annotations

import time
from collections import deque

import zmq

from kouxing_client.errors import KouxingError, Refused
from kouxing_client.messages import Fields, Result, decode, encode
from kouxing_client.resend import AudioLine
from kouxing_client.sockets import Sockets, send
from kouxing_client.subscription import Subscription

REJOIN_S = 1.0  # for subscriptions to be in effect again before audio is sent again
MOVE_LIMIT_S = 5.0  # for a session that its recognizer does not know to move
LAST_S = 0.5  # for the last results of a session that control has closed
AUDIO_QUEUE = 500  # messages


class SessionLink:
    """One session: its audio, if this client opened it, and its subscriptions.

    ``name``, ``signal``, ``errors``, ``failure``, ``is_over``, ``num_added`` and the line's
    ``acknowledged`` are for any thread.

    Parameters
    ----------
    sockets
        The client's.
    endpoints
        What control has told: ``session``, ``epoch``, and addresses by name.
    options
        Of ``open-session``; None: another program opened it.
    """

    def __init__(self, sockets: Sockets, endpoints: Fields, options: Fields | None) -> None:
        self._sockets = sockets
        self.endpoints = endpoints
        self.name: str = endpoints["session"]
        self.epoch: int = endpoints["epoch"]
        self.token: str = endpoints.get("token", "")  # of who opened it
        self.is_live = options is None or bool(options.get("paced", True))
        self.line: AudioLine | None = None
        if options is not None:
            self.line = AudioLine(options["sample_rate_hz"], is_paced=self.is_live)
        self.signal = sockets.make_signal()
        self.errors: deque[Refused] = deque()  # of audio
        self.failure: KouxingError | None = None  # why it is over, unless its owner closed it
        self.is_over = False
        self.num_added = 0  # audio messages
        self.is_blocked = False  # the socket takes no more
        self._audio: zmq.Socket[bytes] | None = None
        self._subscriptions: list[Subscription] = []
        self._rejoin_end_s = 0.0  # until then audio waits for subscriptions
        self._unknown: tuple[float, Refused] | None = None  # the recognizer did not know it
        self._closing: tuple[float, str] | None = None  # control has closed it, and why

    def connect(self) -> None:
        """Connect to the recognizer, if there is audio to be sent."""
        if self.line is not None:
            if self._audio is not None:
                self._sockets.drop(self._audio)
            self._audio = self._sockets.connect(
                zmq.DEALER, [self.endpoints["audio"]], self._on_answer, queue=AUDIO_QUEUE
            )

    def add(self, kind: str, num_frames: int = 0, **fields: bytes) -> None:
        """Send a chunk of so many samples of each channel, or the end of the audio; any thread."""
        self.num_added += 1

        def add() -> None:
            if self.line is not None:
                self.line.add(kind, {"token": self.token, **fields}, num_frames, time.monotonic())

        self._sockets.call(add)

    def flush(self) -> None:
        """Forget audio that is not sent; for any thread."""
        if self.line is not None:
            self._sockets.call(self.line.flush)

    def subscribe(self, classes: tuple[type[Result], ...], shape_set: str) -> Subscription:
        """Return a subscription, which is complete later; for any thread."""
        subscription = Subscription(
            self._sockets, self.name, self.epoch, classes, shape_set, is_live=self.is_live
        )

        def start() -> None:
            if self.is_over:
                subscription.end(self.failure)
                return
            self._subscriptions.append(subscription)
            subscription.start(self.endpoints)

        self._sockets.call(start)
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Close a subscription; for any thread."""

        def stop() -> None:
            if subscription in self._subscriptions:
                self._subscriptions.remove(subscription)
                subscription.end(None)

        self._sockets.call(stop)

    def move(self, moved: Fields) -> None:
        """Go on where control has placed the session; it may say so more than once."""
        if moved["epoch"] <= self.epoch:
            return
        before, self.epoch = self.endpoints, moved["epoch"]
        placed = {name: moved[name] for name in ("audio", "phones", "faps")}
        self.endpoints = {**before, **placed}
        if any(before[name] != placed[name] for name in ("phones", "faps")):
            self._subscribe_again()
        if self.line is not None and moved["next_sequence"]:
            self._unknown = None
            self.line.move(moved["next_sequence"], time.monotonic())
            self.connect()

    def step(self, now_s: float) -> None:
        """Send what waits; notice what does not come."""
        for subscription in self._subscriptions:
            subscription.leave_if_due(now_s)
        if self._closing and now_s > self._closing[0]:
            self.end(KouxingError(f"control has closed the session: {self._closing[1]}"))
        elif self._unknown and now_s > self._unknown[0] + MOVE_LIMIT_S:
            self.end(self._unknown[1])
        elif self.line is not None:
            if self.line.is_stuck(now_s):
                self._subscribe_again()
                self.line.resend(now_s)
                self.connect()
            if not self._is_rejoining(now_s):
                self._send_waiting(self.line)

    def close_soon(self, reason: str) -> None:
        """End when the last results have come: control has closed the session."""
        self._closing = self._closing or (time.monotonic() + LAST_S, reason)

    def end(self, failure: KouxingError | None) -> None:
        """Close all; with a failure the session is no more."""
        self.is_over, self.failure = True, failure
        for subscription in self._subscriptions:
            subscription.end(failure)
        self._subscriptions.clear()
        if self._audio is not None:
            self._sockets.drop(self._audio)
            self._audio = None
        self.signal.notify()

    def _send_waiting(self, line: AudioLine) -> None:
        self.is_blocked = False
        for message in line.waiting():
            parts = encode(message.kind, self.name, {**message.fields, "epoch": self.epoch})
            if self._audio is None or not send(self._audio, parts):
                self.is_blocked = True
                return

    def _is_rejoining(self, now_s: float) -> bool:
        """Return whether audio waits for subscriptions, so that no frame of it is missed."""
        return now_s < self._rejoin_end_s and not all(
            each.is_complete for each in self._subscriptions
        )

    def _subscribe_again(self) -> None:
        self._rejoin_end_s = time.monotonic() + REJOIN_S
        for subscription in self._subscriptions:
            subscription.start(self.endpoints)

    def _on_answer(self, parts: list[bytes]) -> None:
        if (message := decode(parts)) is None or self.line is None:
            return
        kind, fields = message
        if kind == "acknowledge":
            self.line.acknowledge(fields["sequence"], time.monotonic())
        elif kind == "error":
            error = refused(fields)
            if error.code == "unknown-session":
                self._unknown = self._unknown or (time.monotonic(), error)
            else:
                self.errors.append(error)
        self.signal.notify()


def refused(fields: Fields) -> Refused:
    """Return what an ``error`` message says."""
    return Refused(
        str(fields.get("code")), str(fields.get("text")), float(fields.get("retry_after_s", 0.0))
    )
