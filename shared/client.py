"""A client of a running system: opens sessions, streams audio, subscribes to the results."""

from __future__ import annotations

import dataclasses
import secrets
import time
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.bus import AUDIO_QUEUE_LENGTH, CONNECT_MS, Bus, Received
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.follower import PollingLoop, SessionFollower
from kouxing.shared.keys import CLIENT, Key, refusal, user_key
from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk
from kouxing.shared.wire.codec import BadMessage
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.message import MAX_AUDIO_BYTES, Message
from kouxing.shared.wire.session import (
    CloseSession,
    Error,
    ErrorCode,
    FlushSession,
    OpenSession,
    SessionMoved,
    SessionOpened,
    StatusReport,
    StatusRequest,
)

RETRY_S = 1.0
RESEND_S = 10.0  # audio kept for a recognizer that takes the place of a lost one
MAX_KEPT = 5000  # messages of that
MAX_UNSENT = 500  # messages; then whoever sends must wait
ANSWER_S = (0.6, 10.0)  # without an acknowledgement, at first and at most, to connect again
SHORT_CUT_S = 2.5  # until the next attempt, in which who was near before is taken to be so still
NEAREST_MS = 50  # for one connection, at least
MAX_TIMED = 200  # messages whose time is known
HURRIED_ANSWER_S = 5.0  # at first, where audio comes as fast as it is taken and may wait for long
LAST_ANSWER_S = 2.0  # for the end of the audio to be acknowledged before a session is closed
JOIN_STEP_S = 0.1  # at most, until a subscription is in effect: it may have to be made anew
ANSWER_WAIT_S = 0.02  # between looks for it
REJOIN_S = 1.0  # for subscriptions to be in effect again before audio is sent again
MOVE_LIMIT_S = 5.0  # for a session that its recognizer does not know to move


class Refused(UserError):
    """A service refused a request."""

    def __init__(self, code: str, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s  # when it is worth trying again; 0: not stated


class Client:
    """Sends requests to control over one socket; each has an id and a deadline.

    Parameters
    ----------
    control
        Where it takes commands, as ``shared.service.control_endpoint`` returns: address and key.
    key
        Who asks; none: the user. Without a key in ``control`` nothing is encrypted.
    deadline_s
        Time for an answer.
    """

    def __init__(self, control: str, *, key: Key | None = None, deadline_s: float = 10.0) -> None:
        is_plain = " " not in control
        self.bus = Bus(None if is_plain else key or user_key())
        self._control = control
        self._deadline_s = deadline_s
        self._commands = self.bus.connect_dealer(control)
        self._sessions: dict[str, Session] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.bus.close()

    def open_session(self, **options: object) -> Session:
        """Open a session; the keywords are the fields of ``OpenSession``.

        Raises
        ------
        Refused
            If control refuses, with its code and text.
        UserError
            If control does not answer.
        """
        opening = OpenSession(request=_request_id(), **options)  # type: ignore[arg-type]
        opened = self._ask(opening)
        if not isinstance(opened, SessionOpened):
            raise UserError(f"control answered {opened.kind} to open")
        session = self._sessions[opened.session] = Session(self, opening, opened)
        return session

    def close_session(self, session: str, token: str) -> None:
        """Close a session."""
        self._ask(CloseSession(session=session, token=token, request=_request_id()))
        self._sessions.pop(session, None)

    def flush_session(self, session: str, token: str) -> None:
        """Drop audio not yet shown and let the face return to rest."""
        self._ask(FlushSession(session=session, token=token, request=_request_id()))

    def set_face(self, session: str, **settings: object) -> None:
        """Change the face of a session, even of another program's.

        Parameters
        ----------
        session
            Name of the session.
        settings
            Fields of ``FaceSettings``.

        Raises
        ------
        Refused
            If there is no such session, or a number is out of range.
        """
        face = FaceSettings(**settings)  # type: ignore[arg-type]
        self._ask(SetFace(session=session, request=_request_id(), face=face))

    def status(self, session: str = "") -> StatusReport:
        """Return the state of all services and sessions, or of one session and its services.

        Raises
        ------
        Refused
            If there is no such session.
        """
        pages: list[StatusReport] = []
        while not pages or pages[-1].next:
            after = (pages[-1].next or 0) if pages else 0
            page = self._ask(StatusRequest(session=session, request=_request_id(), after=after))
            if not isinstance(page, StatusReport):
                raise UserError(f"control answered {page.kind} to status")
            pages.append(page)
        return dataclasses.replace(
            pages[-1],
            services=[state for page in pages for state in page.services],
            sessions=[state for page in pages for state in page.sessions],
        )

    def take_notices(self) -> None:
        """Handle what control sends unasked: sessions that moved."""
        for received in self._commands.receive():
            self._take_notice(received.message)

    def _take_notice(self, message: Message | BadMessage) -> None:
        if isinstance(message, SessionMoved) and message.session in self._sessions:
            self._sessions[message.session].move(message)

    def _ask(
        self,
        message: OpenSession | CloseSession | FlushSession | SetFace | StatusRequest,
    ) -> Message:
        deadline_s = time.monotonic() + self._deadline_s
        # Only the last try counts: an address that is shut out for a while is let in again.
        is_refused = False
        while time.monotonic() < deadline_s:
            self._commands.send(message)
            retry_s = min(deadline_s, time.monotonic() + RETRY_S)
            while (left_s := retry_s - time.monotonic()) > 0:
                if not self._commands.wait(left_s):
                    continue
                for received in self._commands.receive():
                    answer = received.message
                    self._take_notice(answer)
                    if isinstance(answer, Error) and answer.code == ErrorCode.BAD_MESSAGE:
                        raise Refused(
                            answer.code, answer.text
                        )  # control could not read our request
                    if getattr(answer, "request", None) != message.request:
                        continue
                    if isinstance(answer, Error):
                        raise Refused(answer.code, answer.text, answer.retry_after_s or 0.0)
                    if isinstance(answer, Message):
                        return answer
            is_refused = self.bus.is_refused(self._control)
            if not self._commands.can_send:  # something else was at its address
                self.bus.drop(self._commands)
                self._commands = self.bus.connect_dealer(self._control)
        if is_refused:
            raise UserError(refusal(self._control, CLIENT, ("client",)))
        address = self._control.partition(" ")[0]
        raise UserError(
            f"control at {address} does not answer; is it running? to start it: kouxing run"
        )


class Session:
    """One open session: sends audio and subscribes to what comes out.

    When control moves the session to another recognizer, the session sends the audio again that the
    lost one did not get, and its subscriptions follow. When nothing is acknowledged any more, it
    connects again, and sends what was not. Whoever uses the session need not notice: calls of
    ``send``, ``finish`` and ``errors`` do that.
    """

    def __init__(self, client: Client, opening: OpenSession, opened: SessionOpened) -> None:
        self._client = client
        self._opening = opening
        self.opened = opened  # with the endpoints of the newest move
        self.name = opened.session
        self._audio = client.bus.connect_dealer(opened.audio, queue_length=AUDIO_QUEUE_LENGTH)
        self._subscriptions: list[Subscription] = []
        self._sequence = 0
        self._num_frames_sent = 0
        self._has_finished = False
        self._kept: deque[AudioChunk] = deque(maxlen=MAX_KEPT)
        self._next = 1  # number of the next message for the socket
        self._acknowledged = 0  # number of the newest message that the recognizer has
        self._progress_s = 0.0  # when something was acknowledged, or the first message waited
        self._least_answer_s = ANSWER_S[0] if opening.paced else HURRIED_ANSWER_S
        self._answer_s = self._least_answer_s  # how long to wait for more
        self._near_ms = CONNECT_MS  # in which the recognizer can be reached, by its quickest answer
        self._sent_s: deque[tuple[int, float]] = deque(maxlen=MAX_TIMED)  # numbers and times
        self._rejoin_end_s = 0.0  # until then audio waits for subscriptions
        self._errors: deque[Error] = deque()
        self._unknown: tuple[float, Error] | None = (
            None  # when the recognizer did not know the session
        )

    @property
    def media_time(self) -> int:
        """Media time of the next chunk, samples at 16 kHz."""
        return self._num_frames_sent * MEDIA_RATE_HZ // self._opening.sample_rate_hz

    def send(self, samples: NDArray[np.generic]) -> bool:
        """Send a chunk of shape ``(n,)`` or ``(n, channels)`` in the session's encoding.

        Returns False if the queue is full: wait and send the same chunk again.
        """
        kind = "<i2" if self._opening.encoding == "s16le" else "<f4"
        return self.send_pcm(samples.astype(kind).tobytes(), len(samples))

    def send_pcm(self, pcm: bytes, num_frames: int) -> bool:
        """Send a chunk of PCM that is in the session's encoding already.

        Returns False if the queue is full, as ``send`` does.

        Raises
        ------
        UserError
            If the chunk is larger than a message may carry.
        """
        if len(pcm) > MAX_AUDIO_BYTES:
            raise UserError(f"a chunk of {len(pcm)} bytes is too large; send {MAX_AUDIO_BYTES}")
        chunk = AudioChunk(
            session=self.name,
            epoch=self.opened.epoch,
            token=self.opened.token,
            sequence=self._sequence + 1,
            media_time=self.media_time,
            pcm=pcm,
            acknowledge=True,
        )
        if not self._send(chunk):
            return False
        self._num_frames_sent += num_frames
        return True

    def skip(self, num_frames: int) -> None:
        """Leave audio out that could not be sent: media time goes on without it."""
        self._num_frames_sent += num_frames

    def finish(self) -> bool:
        """Say that no more audio comes; False if the queue is full, as in ``send``."""
        if not self._has_finished:
            self._has_finished = self._send(
                AudioChunk(
                    session=self.name,
                    epoch=self.opened.epoch,
                    token=self.opened.token,
                    sequence=self._sequence + 1,
                    media_time=self.media_time,
                    last=True,
                    acknowledge=True,
                )
            )
        self._send_waiting()
        return self._next > self._sequence

    def errors(self) -> Iterator[Error]:
        """Yield the recognizer's errors since the last call.

        An unknown session is reported only after a while: a recognizer that has just started again
        does not know it before control has moved the session.
        """
        self._send_waiting()
        now_s = time.monotonic()
        while self._errors:
            error = self._errors.popleft()
            if error.code == ErrorCode.UNKNOWN_SESSION:
                self._unknown = self._unknown or (now_s, error)
            else:
                yield error
        if self._unknown is not None and now_s - self._unknown[0] > MOVE_LIMIT_S:
            yield self._unknown[1]
            self._unknown = None

    def subscribe(self, *kinds: type[Message], deadline_s: float = 5.0) -> Subscription:
        """Return a subscription to messages of this session, once it has taken effect.

        Raises
        ------
        UserError
            If a publisher does not confirm the subscription in time.
        """
        subscription = Subscription(self._client.bus, self.name, kinds, live=self._opening.paced)
        subscription.start(self.opened)
        subscription.wait_until_complete(deadline_s)
        self._subscriptions.append(subscription)
        return subscription

    def move(self, moved: SessionMoved) -> None:
        """Go on where control has placed the session; it may say so more than once."""
        before = self.opened
        if moved.epoch <= before.epoch:
            return
        self.opened = dataclasses.replace(
            before, epoch=moved.epoch, audio=moved.audio, phones=moved.phones, faps=moved.faps
        )
        if (before.phones, before.faps) != (moved.phones, moved.faps):
            self._subscribe_again()
        if moved.next_sequence:
            self._acknowledged = moved.next_sequence - 1
            self._unknown = None
            self._connect_audio()

    def flush(self) -> None:
        """Interrupt: drop audio not yet shown; none of it is sent again."""
        self._client.flush_session(self.name, self.opened.token)
        self._kept = deque((each for each in self._kept if each.last), maxlen=MAX_KEPT)

    def set_face(self, **settings: object) -> None:
        """Change the session's face, as ``Client.set_face``."""
        self._client.set_face(self.name, **settings)

    def close(self) -> None:
        """Close the session; after ``finish`` once the recognizer has told all its results."""
        end_s = time.monotonic() + LAST_ANSWER_S
        while self._has_finished and self._acknowledged < self._sequence:
            self._audio.wait(ANSWER_WAIT_S)
            self._send_waiting()
            if time.monotonic() > end_s:
                break
        self._client.close_session(self.name, self.opened.token)

    def _send(self, message: AudioChunk) -> bool:
        """Send a new message; return False if the queue is full.

        While subscriptions are renewed, it may wait behind others.
        """
        self._send_waiting()
        if self._is_rejoining():
            if self._sequence + 1 - self._next >= MAX_UNSENT:
                return False
        elif self._next <= self._sequence or not self._give(message):
            return False
        else:
            self._next += 1
        now_s = time.monotonic()
        if self._acknowledged == self._sequence:
            self._progress_s = now_s
        self._sent_s.append((message.sequence, now_s))
        self._sequence = message.sequence
        self._kept.append(message)
        oldest_needed = message.media_time - RESEND_S * MEDIA_RATE_HZ
        while self._kept[0].sequence <= self._acknowledged:
            if self._kept[0].media_time >= oldest_needed:
                break
            self._kept.popleft()
        return True

    def _send_waiting(self) -> None:
        """Take what has come, and give the socket as many messages as it takes."""
        self._client.take_notices()
        self._take_answers()
        is_late = 0 < self._acknowledged < self._sequence  # an older recognizer says nothing
        if is_late and time.monotonic() - self._progress_s > self._answer_s:
            self._reconnect()
        if self._is_rejoining():
            return
        oldest = self._kept[0].sequence if self._kept else self._sequence + 1
        self._next = max(self._next, oldest)
        while self._next <= self._sequence:
            message = self._kept[self._next - oldest]
            if not self._give(message):
                return
            self._next += 1

    def _give(self, message: AudioChunk) -> bool:
        """Give the socket a message; return whether it took it."""
        return self._audio.send(dataclasses.replace(message, epoch=self.opened.epoch))

    def _is_rejoining(self) -> bool:
        """Return whether audio waits for subscriptions, so that no frame of it is missed."""
        return time.monotonic() < self._rejoin_end_s and not all(
            each.has_joined() for each in self._subscriptions
        )

    def _take_answers(self) -> None:
        """Take the recognizer's acknowledgements and errors."""
        for received in self._audio.receive():
            message = received.message
            if isinstance(message, Error):
                self._errors.append(message)
            elif isinstance(message, AcknowledgeAudio) and message.sequence > self._acknowledged:
                now_s = time.monotonic()
                while self._sent_s and self._sent_s[0][0] <= message.sequence:
                    number, sent_s = self._sent_s.popleft()
                    if number == message.sequence:
                        near_ms = max(round(2e3 * (now_s - sent_s)), NEAREST_MS)
                        self._near_ms = min(near_ms, self._near_ms)
                self._acknowledged = min(message.sequence, self._sequence)
                self._progress_s = now_s
                self._answer_s = max(self._least_answer_s, self._answer_s / 2)

    def _reconnect(self) -> None:
        """Give up the sockets: nothing comes through, but TCP may not say so for long.

        A packet that is lost while a connection is made costs the whole time for it.
        """
        self._answer_s = min(2 * self._answer_s, ANSWER_S[1])
        bus = self._client.bus
        bus.connect_ms = self._near_ms if self._answer_s <= SHORT_CUT_S else CONNECT_MS
        self._subscribe_again()
        self._connect_audio()
        bus.connect_ms = CONNECT_MS

    def _subscribe_again(self) -> None:
        self._rejoin_end_s = time.monotonic() + REJOIN_S
        for subscription in self._subscriptions:
            subscription.start(self.opened)

    def _connect_audio(self) -> None:
        """Connect to the recognizer again; what it does not have goes first."""
        self._client.bus.drop(self._audio, linger_s=0.0)
        self._audio = self._client.bus.connect_dealer(
            self.opened.audio, queue_length=AUDIO_QUEUE_LENGTH
        )
        self._next = self._acknowledged + 1
        self._progress_s = time.monotonic()


class Subscription:
    """Messages of one session in the order in which they arrive."""

    def __init__(
        self, bus: Bus, session: str, kinds: Iterable[type[Message]], *, live: bool
    ) -> None:
        self._loop = PollingLoop(bus)
        self._received: deque[Received] = deque()
        self._follower = SessionFollower(
            self._loop, session, dict.fromkeys(kinds, self._take), live=live
        )

    def start(self, opened: SessionOpened) -> None:
        """Subscribe at the session's publishers; again when they are others."""
        self._follower.start(opened.epoch, {"phones": opened.phones, "faps": opened.faps})

    def wait_until_complete(self, deadline_s: float) -> None:
        """Wait until the subscription is in effect.

        Raises
        ------
        UserError
            If a publisher does not confirm in time.
        """
        end_s = time.monotonic() + deadline_s
        while not self._follower.is_complete:
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                raise UserError("a publisher did not confirm the subscription")
            self._loop.step(min(left_s, JOIN_STEP_S))

    def has_joined(self) -> bool:
        """Take what has arrived; return whether the subscription is in effect."""
        self._loop.step(0.0)
        return self._follower.is_complete

    def wait(self, timeout_s: float) -> bool:
        """Return whether something arrived within the time."""
        end_s = time.monotonic() + timeout_s
        # A step may end with a publisher's confirmation, which is none of what is waited for.
        while not self._received and self._loop.step(max(0.0, end_s - time.monotonic())):
            pass
        return bool(self._received)

    def receive(self) -> Iterator[Received]:
        """Yield what has arrived."""
        self._loop.step(0.0)
        while self._received:
            yield self._received.popleft()

    def _take(self, message: Message) -> None:
        self._received.append(Received(message))


def _request_id() -> str:
    return secrets.token_hex(8)
