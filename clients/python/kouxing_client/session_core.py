"""One session: its audio, its subscriptions and its moves, without I/O."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from kouxing_client.audio import AudioStream
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.follower import Follower
from kouxing_client.inbox import Inbox, Signal, new_future
from kouxing_client.messages import (
    EndOfFaps,
    FapFrame,
    Fields,
    Joined,
    Message,
    Phone,
    Result,
    Shapes,
    Speech,
    decode,
    encode,
    topic,
)
from kouxing_client.phone_track import PhoneTrack

if TYPE_CHECKING:
    from kouxing_client.sockets import Connection, Sockets

RESUBSCRIBE_S = 1.0  # how long audio waits until subscriptions are in effect again
MOVE_TIMEOUT_S = 5.0  # limit for the move of a session whose recognizer is lost
END_TIMEOUT_S = 5.0  # maximum wait for the last phones after the last frame
LAST_RESULTS_WAIT_S = 0.5  # wait for the last results of a session that control has closed
AUDIO_QUEUE_MESSAGES = 500
MAX_ERRORS = 100  # the newest errors that the program has not taken
SILENT_S = 2.0  # without results for this time, a session may have moved or ended


class Subscription:
    """Passes on the results of one session, in order of arrival.

    Parameters
    ----------
    shape_set
        Name of the set of blendshapes, if ``classes`` has ``Shapes``.
    inbox
        Receives the results; ends with the session.
    on_result
        Called with each result, in place of the inbox.

    Attributes
    ----------
    joined
        Done when the subscription is in effect, or has failed.
    """

    def __init__(
        self,
        session: SessionCore,
        classes: tuple[type[Result], ...],
        shape_set: str,
        inbox: Inbox,
        on_result: Callable[[Any], None] | None = None,
    ) -> None:
        self.inbox = inbox
        self.joined: Future[None] = new_future()
        self._session = session
        self._shape_set = shape_set
        self._on_result = on_result or inbox.add
        self._classes = classes
        self._phones = PhoneTrack()
        needed: set[type[Message]] = {
            EndOfFaps,
            *(FapFrame if cls is Shapes else cls for cls in classes),
        }
        self.follower = Follower(
            session.sockets,
            session.name,
            needed | {Speech} if Phone in classes else needed,
            self._on_message,
            is_paced=session.is_paced,
            on_complete=self._on_complete,
        )
        self._end_deadline_s = math.inf
        self._awaits_last_phones = False

    def start(self) -> None:
        """Subscribe where the session is published now."""
        self._awaits_last_phones = False
        self.follower.start(self._session.epoch, self._session.endpoints)

    def tick(self) -> None:
        """Check for expired deadlines; call this regularly."""
        self.follower.tick()
        if self.follower.has_ended and self._session.sockets.now_s > self._end_deadline_s:
            self._end_deadline_s = math.inf
            self.inbox.end(None)

    def end(self, failure: KouxingError | None) -> None:
        """Stop; ``failure`` is the reason why the session has ended early."""
        try:
            self.follower.drain()
        except Exception as error:  # raised by ``on_result``; other subscriptions must also end
            failure = KouxingError(f"on_result failed: {error!r}")
            failure.__cause__ = error
            self.inbox.end(failure)  # even if the last frame has arrived
        self.follower.close()
        self.inbox.end(None if self.follower.has_ended else failure)
        if not self.joined.done():
            self.joined.set_exception(failure or KouxingError("the subscription is closed"))

    def _on_message(self, message: Any) -> None:
        if isinstance(message, EndOfFaps):
            self._on_end()
        elif isinstance(message, Phone):
            self._deliver(self._phones.update(message))
        elif isinstance(message, Speech):
            self._deliver(self._phones.add_speech(message))
        self.inbox.num_missed = self.follower.num_missed + self._phones.num_missed
        if type(message) in self._classes and not isinstance(message, Phone):
            self._on_result(message)
        if Shapes in self._classes and isinstance(message, FapFrame):
            weights = message.packed_shapes.get(self._shape_set)
            if weights is not None:
                header = {name: getattr(message, name) for name in Message.__struct_fields__}
                self._on_result(Shapes(**header, set=self._shape_set, packed_weights=weights))

    def _on_end(self) -> None:
        """End; before that, wait for the last phones, because they have another publisher."""
        if Phone not in self._classes:
            self.inbox.end(None)
            return
        self._end_deadline_s = self._session.sockets.now_s + END_TIMEOUT_S
        self._awaits_last_phones = False
        if self.follower.is_complete:
            self._await_last_phones()

    def _await_last_phones(self) -> None:
        """Subscribe to confirmations again.

        A publisher confirms a subscription after everything that it has published before.
        """
        self._awaits_last_phones = True
        joined = [topic(Joined.kind, self._session.name)]
        connection = self.follower.await_confirmation()
        for on in (False, True):
            self._session.sockets.set_topics(connection, joined, on=on)

    def _on_complete(self) -> None:
        if self.follower.has_ended and not self.inbox.has_ended:
            if self._awaits_last_phones:
                self.inbox.end(None)
            else:  # this confirms an earlier subscription
                self._await_last_phones()
        if not self.joined.done():
            self.joined.set_result(None)

    def _deliver(self, phones: list[Phone]) -> None:
        for phone in phones:
            self._on_result(phone)


@dataclass(frozen=True)
class _PendingEnd:
    """An end of the session that takes effect at a deadline."""

    deadline_s: float
    failure: KouxingError


class SessionCore:
    """One session: its audio, if this client opened it, and its subscriptions.

    Any thread may use ``name``, ``token``, ``signal``, ``errors``, ``failure`` and ``has_ended``.

    Parameters
    ----------
    opened
        Control's answer: ``session``, ``epoch``, and endpoints by name.
    options
        Fields of ``open-session``; None if another program opened the session.
    is_paced
        Whether the audio arrives in real time, so that late results are worthless.
    """

    def __init__(
        self, sockets: Sockets, opened: Fields, options: Fields | None, *, is_paced: bool
    ) -> None:
        self.sockets = sockets
        self.endpoints = opened
        self.name: str = opened["session"]
        self.epoch: int = opened["epoch"]
        self.session_id: str | None = opened.get("session_id")
        self.token: str = opened.get("token", "")
        self.is_paced = is_paced
        self.stream: AudioStream | None = None
        if options is not None:
            self.stream = AudioStream(options["sample_rate_hz"], is_paced=self.is_paced)
        self.signal = Signal()  # notified of changes
        self.errors: deque[Refused] = deque(maxlen=MAX_ERRORS)  # errors about the audio
        self.failure: KouxingError | None = None  # reason for the end; None: closed
        self.has_ended = False
        self.is_blocked = False  # the audio socket accepts no more
        self.last_located_s = 0.0  # when control was last asked where the silent session is
        self._audio: Connection | None = None
        self._subscriptions: list[Subscription] = []
        self._resubscribe_end_s = 0.0  # audio waits for subscriptions until this time
        self._unknown: _PendingEnd | None = None  # the recognizer does not have the session
        self._closed: _PendingEnd | None = None  # control has closed the session

    def is_about(self, name: str, session_id: str | None) -> bool:
        """Return whether a message with this session name and id is about this session.

        A late message may be about an earlier session of the same name.
        """
        is_known = session_id is not None and self.session_id is not None
        return name == self.name and (session_id == self.session_id or not is_known)

    def connect(self) -> None:
        """Connect to the recognizer, if this client sends audio."""
        if self.stream is None:
            return
        if self._audio is not None:
            self.sockets.close_connection(self._audio)
        audio = self.endpoints["audio"]
        self._audio = self.sockets.connect(audio, self._on_answer, queue=AUDIO_QUEUE_MESSAGES)

    def add_audio(self, num_samples: int, fields: Fields) -> None:
        """Send a chunk of ``num_samples`` samples per channel."""
        if self.stream is not None and not self.has_ended:
            fields = {"token": self.token, **fields}
            self.stream.add(fields, num_samples, self.sockets.now_s)
            self.send_audio()

    def send_audio(self) -> None:
        """Pass audio to the socket until it is full, unless audio waits for subscriptions."""
        self.is_blocked = False
        if self.stream is None or self._audio is None or self._is_resubscribing():
            return
        for message in self.stream.unsent():
            parts = encode("audio-chunk", self.name, {**message, "epoch": self.epoch})
            if not self.sockets.send(self._audio, parts):
                self.is_blocked = True
                return

    def subscribe(self, subscription: Subscription) -> None:
        """Start a subscription."""
        if self.has_ended:
            subscription.end(self.failure or KouxingError("the session is closed"))
            return
        try:
            subscription.start()
        except KouxingError as error:  # such as an endpoint that the session does not have
            subscription.end(error)
        else:
            self._subscriptions.append(subscription)

    def unsubscribe(self, subscription: Subscription) -> None:
        """End a subscription."""
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)
            subscription.end(None)

    def move(self, moved: Fields) -> None:
        """Continue where control has placed the session; repeated messages have no effect."""
        if moved["epoch"] <= self.epoch:
            return
        self.epoch = moved["epoch"]
        self.set_endpoints({name: moved[name] for name in ("audio", "phones", "faps")})
        next_sequence = moved.get("next_sequence")
        if self.stream is not None and next_sequence:
            self._unknown = None
            self.stream.move(next_sequence, self.sockets.now_s)
            self.connect()

    def set_endpoints(self, endpoints: Fields) -> None:
        """Subscribe again if the session is published somewhere else now."""
        old, self.endpoints = self.endpoints, {**self.endpoints, **endpoints}
        if any(old[name] != self.endpoints[name] for name in ("phones", "faps")):
            self._subscribe_again()

    def is_silent(self) -> bool:
        """Return whether a session of another program has published nothing for a while."""
        arrivals = [sub.follower.received_at_s for sub in self._subscriptions]
        is_followed = self.stream is None and bool(arrivals)
        return is_followed and self.sockets.now_s > max(arrivals) + SILENT_S

    def tick(self) -> None:
        """Send waiting audio; detect missing answers and expired deadlines."""
        now_s = self.sockets.now_s
        for subscription in self._subscriptions:
            subscription.tick()
        ends = (self._closed, self._unknown)
        due = [pending for pending in ends if pending is not None and now_s > pending.deadline_s]
        if due:
            self.end(due[0].failure)
        elif self.stream is not None:
            if self.stream.is_stuck(now_s):
                self._reconnect(self.stream)
            self.send_audio()

    def close_after_results(self, reason: str) -> None:
        """End after the last results have arrived: control has closed the session."""
        if self._closed is None:
            failure = KouxingError(f"control has closed the session: {reason}")
            self._closed = _PendingEnd(self.sockets.now_s + LAST_RESULTS_WAIT_S, failure)

    def end(self, failure: KouxingError | None) -> None:
        """Close all connections; ``failure`` is the reason for an early end."""
        self.has_ended, self.failure = True, failure
        for subscription in self._subscriptions:
            subscription.end(failure)
        self._subscriptions.clear()
        if self._audio is not None:
            self.sockets.close_connection(self._audio)
            self._audio = None
        self.signal.notify()

    def _reconnect(self, stream: AudioStream) -> None:
        """Replace connections over which nothing arrives; TCP may take long to report that."""
        stream.resend(self.sockets.now_s)
        usual_ms = self.sockets.connect_ms
        self.sockets.connect_ms = stream.connect_ms(usual_ms)
        self._subscribe_again()
        self.connect()
        self.sockets.connect_ms = usual_ms

    def _subscribe_again(self) -> None:
        self._resubscribe_end_s = self.sockets.now_s + RESUBSCRIBE_S
        for subscription in self._subscriptions:
            subscription.start()

    def _is_resubscribing(self) -> bool:
        """Return whether audio waits for subscriptions, so that no frame of it is missed."""
        return self.sockets.now_s < self._resubscribe_end_s and not all(
            subscription.follower.is_complete for subscription in self._subscriptions
        )

    def _on_answer(self, parts: list[bytes]) -> None:
        if (message := decode(parts)) is None or self.stream is None:
            return
        kind, fields = message
        if kind == "acknowledge":
            self.stream.acknowledge(fields["sequence"], self.sockets.now_s)
        elif kind == "error":
            error = refused(fields)
            if error.code == "unknown-session":  # the recognizer restarted
                deadline_s = self.sockets.now_s + MOVE_TIMEOUT_S
                self._unknown = self._unknown or _PendingEnd(deadline_s, error)
            elif error.code == "bad-message":  # a chunk that is never acknowledged
                self.end(error)
            else:
                self.errors.append(error)
        self.signal.notify()


def refused(fields: Fields) -> Refused:
    """Convert an ``error`` message."""
    return Refused(
        str(fields.get("code")), str(fields.get("text")), fields.get("retry_after_s") or 0.0
    )
