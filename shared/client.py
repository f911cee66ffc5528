"""A client of a running system: opens sessions, streams audio, follows what comes out."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray

from shared.bus import AUDIO_QUEUE_LENGTH, Bus, Socket
from shared.errors import UserError
from shared.messages import (
    MAX_AUDIO_BYTES,
    MEDIA_RATE_HZ,
    AudioChunk,
    CloseSession,
    EndOfAudio,
    Error,
    FlushSession,
    Joined,
    Message,
    OpenSession,
    SessionOpened,
    StatusReport,
    StatusRequest,
)

RETRY_S = 1.0


class Refused(UserError):
    """A service said no."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text


class Client:
    """Commands to control over one socket; every request has an id and a deadline."""

    def __init__(self, control: str, *, deadline_s: float = 10.0) -> None:
        self.bus = Bus()
        self._control = control
        self._deadline_s = deadline_s
        self._commands = self.bus.connect_dealer(control)

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
        return Session(self, opening, opened)

    def close_session(self, session: str, token: str) -> None:
        """Close a session."""
        self._ask(CloseSession(session=session, token=token, request=_request_id()))

    def flush_session(self, session: str, token: str) -> None:
        """Drop what is queued and let the face return to rest."""
        self._ask(FlushSession(session=session, token=token, request=_request_id()))

    def status(self) -> StatusReport:
        """Return the state of all services and sessions."""
        report = self._ask(StatusRequest(request=_request_id()))
        if not isinstance(report, StatusReport):
            raise UserError(f"control answered {report.kind} to status")
        return report

    def _ask(self, message: OpenSession | CloseSession | FlushSession | StatusRequest) -> Message:
        deadline_s = time.monotonic() + self._deadline_s
        while time.monotonic() < deadline_s:
            self._commands.send(message)
            retry_s = min(deadline_s, time.monotonic() + RETRY_S)
            while (left_s := retry_s - time.monotonic()) > 0:
                if not self._commands.wait(left_s):
                    continue
                for received in self._commands.receive():
                    answer = received.message
                    if isinstance(answer, Error) and answer.code == "bad-message":
                        raise Refused(
                            answer.code, answer.text
                        )  # control could not read our request
                    if getattr(answer, "request", None) != message.request:
                        continue
                    if isinstance(answer, Error):
                        raise Refused(answer.code, answer.text)
                    if isinstance(answer, Message):
                        return answer
        raise UserError(
            f"control at {self._control} does not answer; is 'kouxing run' running there?"
        )


class Session:
    """One open session: sends audio and subscribes to what comes out."""

    def __init__(self, client: Client, opening: OpenSession, opened: SessionOpened) -> None:
        self._client = client
        self._opening = opening
        self.opened = opened
        self.name = opened.session
        self._audio = client.bus.connect_dealer(opened.audio, queue_length=AUDIO_QUEUE_LENGTH)
        self._sequence = 0
        self._num_frames_sent = 0

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

        Raises
        ------
        UserError
            If the chunk is larger than a message may carry.
        """
        if len(pcm) > MAX_AUDIO_BYTES:
            raise UserError(f"a chunk of {len(pcm)} bytes is too large; send {MAX_AUDIO_BYTES}")
        sent = self._audio.send(
            AudioChunk(
                session=self.name,
                token=self.opened.token,
                sequence=self._sequence + 1,
                media_time=self.media_time,
                pcm=pcm,
            )
        )
        if sent:
            self._sequence += 1
            self._num_frames_sent += num_frames
        return sent

    def finish(self) -> bool:
        """Say that no more audio comes; False if the queue is full, as in ``send``."""
        sent = self._audio.send(
            EndOfAudio(
                session=self.name,
                token=self.opened.token,
                sequence=self._sequence + 1,
                media_time=self.media_time,
            )
        )
        self._sequence += sent
        return sent

    def errors(self) -> Iterator[Error]:
        """Yield what the recognizer complained about since the last call."""
        for received in self._audio.receive():
            if isinstance(received.message, Error):
                yield received.message

    def subscribe(self, *kinds: type[Message], deadline_s: float = 5.0) -> Socket:
        """Return a subscription to messages of this session, once it has taken effect.

        Raises
        ------
        UserError
            If a publisher does not confirm the subscription in time.
        """
        publisher_of = {
            **dict.fromkeys(("phone", "speech", "sound"), self.opened.phones),
            **dict.fromkeys(("fap", "end"), self.opened.faps),
        }
        endpoints = sorted({publisher_of[kind.kind] for kind in kinds})
        socket = self._client.bus.connect_subscriber(*endpoints)
        socket.subscribe_session(kinds, self.name)
        wait_until_joined(socket, len(endpoints), deadline_s)
        return socket

    def flush(self) -> None:
        """Interrupt: drop what is queued."""
        self._client.flush_session(self.name, self.opened.token)

    def close(self) -> None:
        """Close the session."""
        self._client.close_session(self.name, self.opened.token)


def wait_until_joined(socket: Socket, num_publishers: int, deadline_s: float) -> None:
    """Wait until the subscriptions of a socket, new and without traffic yet, are in effect.

    Raises
    ------
    UserError
        If a publisher does not confirm in time.
    """
    end_s = time.monotonic() + deadline_s
    publishers: set[str] = set()
    while len(publishers) < num_publishers:
        left_s = end_s - time.monotonic()
        if left_s <= 0:
            raise UserError("a publisher did not confirm the subscription")
        if socket.wait(left_s):
            for received in socket.receive():
                if isinstance(received.message, Joined):
                    publishers.add(received.message.publisher)


def _request_id() -> str:
    return secrets.token_hex(8)
