"""The common base of ``Client`` and ``AsyncClient``: arguments, audio formats and waiting."""

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

from kouxing_client.audio import SAMPLE_BYTES, check_channels, split, to_pcm
from kouxing_client.core import ClientCore
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.inbox import Inbox, new_future
from kouxing_client.keys import Key, find_key, read_key
from kouxing_client.messages import MEDIA_RATE_HZ, Fields, Result
from kouxing_client.options import check_name, check_results
from kouxing_client.session_core import SessionCore, Subscription
from kouxing_client.thread import ClientThread

CONTROL = "tcp://127.0.0.1:5550"
CHUNK_BYTES = 32_000  # largest chunk in one message
MAX_UNREAD_RESULTS = 100  # of a live session
MAX_UNREAD_EVENTS = 1000  # of a session
MAX_UNACKNOWLEDGED_MESSAGES = 500  # then the sender waits
LAST_ANSWER_S = 2.0  # limit for delivering the end of the audio before a session closes


class BaseClient:
    """A connection to a running system.

    Parameters
    ----------
    control
        Address of control. The default is ``$KOUXING_CONTROL``, or ``tcp://127.0.0.1:5550`` if that
        is not set. Control's public key may follow after a space.
    key
        Key of this program, or the path of its file; default: the user's own key (``find_key``).
    insecure
        Whether the system has ``insecure = true``, so that nothing is encrypted.
    timeout_s
        Time limit for an answer.
    start_s
        Time for control to start: a request fails after this time if nothing listens at its
        address and it has not answered yet.

    Raises
    ------
    KouxingError
        If no key is found, or the address is invalid.
    """

    def __init__(
        self,
        control: str | None = None,
        *,
        key: Key | str | Path | None = None,
        insecure: bool = False,
        timeout_s: float = 10.0,
        start_s: float = 2.0,
    ) -> None:
        control = control or os.environ.get("KOUXING_CONTROL") or CONTROL
        if isinstance(key, str | Path):
            key = read_key(key)
        key = None if insecure else key or find_key()
        self._thread = ClientThread(control, key, timeout_s, start_s)
        self._unused: set[Future[None]] = set()  # sessions whose opening was interrupted

    @property
    def is_closed(self) -> bool:
        """Whether ``close`` was called or a fatal error occurred, such as too many open files."""
        return not self._thread.is_running

    def _request(self, kind: str, session: str, fields: Fields) -> Future[Fields]:
        check_name(session)
        return self._thread.submit(lambda core: core.request(kind, session, **fields))

    def _close_unused(self, opened: Future[SessionCore]) -> None:
        """Close a session as soon as it opens, because its opening was interrupted."""
        closed = new_future()
        self._unused.add(closed)
        closed.add_done_callback(self._unused.discard)

        def close(opened: Future[SessionCore]) -> None:
            if opened.exception() is not None:
                closed.set_result(None)
                return
            core = opened.result()
            answer = self._thread.submit(
                lambda client: client.request("close-session", core.name, token=core.token),
                may_wait=False,
            )
            answer.add_done_callback(lambda _: closed.set_result(None))
            self._thread.disconnect(core)

        opened.add_done_callback(close)


class BaseSession:
    """One session. Any program can receive its results; the program that opened it sends audio.

    Lost messages are resent. Results continue when the session moves to another worker. The session
    is a context manager that closes it at the end.
    """

    def __init__(self, thread: ClientThread, core: SessionCore, options: Fields | None) -> None:
        self._thread = thread
        self._core = core
        self._signal = core.signal
        self._options = options
        self._num_added = 0  # audio messages
        self._num_pushed = 0  # samples per channel, including skipped ones
        self._partial_sample = b""  # the first bytes of the next sample
        self._has_finished = False

    @property
    def name(self) -> str:
        """Name of the session."""
        return self._core.name

    @property
    def info(self) -> Fields:
        """The fields of ``session-opened`` with the current epoch and endpoints.

        Another program's session has only ``session``, ``session_id``, ``epoch``, ``facts`` and the
        endpoints.
        """
        return {**self._core.endpoints, "epoch": self._core.epoch}

    @property
    def media_time(self) -> int:
        """Media time of the next chunk, samples at 16 kHz."""
        if self._options is None:  # another program sends the audio
            return 0
        return self._num_pushed * MEDIA_RATE_HZ // int(self._options["sample_rate_hz"])

    def try_push(self, pcm: bytes) -> bool:
        """Send PCM without blocking. Return False if too much audio is unacknowledged.

        Raises
        ------
        KouxingError
            If the audio or the session has ended, or another program opened the session.
        """
        self._num_samples(pcm)
        self._check_unfinished()
        self._check_open()
        if not self._has_room():
            return False
        for chunk in split(pcm, CHUNK_BYTES):
            self._add(chunk, self._num_samples(chunk))
        return True

    def skip(self, num_samples: int) -> None:
        """Advance media time by ``num_samples`` samples per channel without sending audio.

        Raises
        ------
        KouxingError
            As ``try_push``, or if the number is negative.
        """
        self._check_sender()
        self._check_unfinished()
        self._check_open()
        count = int(num_samples)  # NumPy integers cannot be encoded
        if count < 0:
            raise KouxingError(f"num_samples must be at least 0, not {count}")

        self._num_pushed += count

        def skip() -> None:
            if self._core.stream is not None:
                self._core.stream.skip(count)

        self._thread.call(skip)

    def take_errors(self) -> list[Refused]:
        """Return errors about audio since the last call of this method or ``push``.

        Raises
        ------
        KouxingError
            If the session has ended.
        """
        self._check_open()
        errors = self._core.errors
        return [errors.popleft() for _ in range(len(errors))]

    @property
    def _frame_bytes(self) -> int:
        self._check_sender()
        options = self._options or {}
        return int(SAMPLE_BYTES[options["encoding"]] * options["num_channels"])

    def _check_sender(self) -> None:
        if self._options is None:
            raise KouxingError(
                "another program opened this session; only that program can send audio"
            )

    def _num_samples(self, pcm: bytes) -> int:
        num_samples, rest = divmod(len(pcm), self._frame_bytes)
        if rest:
            raise KouxingError(
                f"{len(pcm)} bytes are not complete samples; use push, which accepts any length"
            )
        return num_samples

    def _chunks(self, audio: Any) -> Iterator[tuple[bytes, int]]:
        """Yield messages of PCM and their number of samples per channel."""
        self._check_sender()
        self._check()
        self._check_unfinished()
        options = self._options or {}
        check_channels(audio, options["num_channels"])
        pcm = self._partial_sample + to_pcm(audio, options["encoding"])
        end = len(pcm) // self._frame_bytes * self._frame_bytes
        pcm, self._partial_sample = pcm[:end], pcm[end:]
        for chunk in split(pcm, CHUNK_BYTES):
            yield chunk, self._num_samples(chunk)

    def _add(self, pcm: bytes, num_samples: int) -> None:
        self._check_open()
        self._num_added += 1
        self._num_pushed += num_samples
        self._thread.call(lambda: self._core.add_audio(num_samples, {"pcm": pcm}))

    def _finish(self) -> None:
        self._check_sender()
        self._check()
        if not self._has_finished:
            self._has_finished = True
            self._num_added += 1
            self._thread.call(lambda: self._core.add_audio(0, {"last": True}))

    def _request(self, kind: str, fields: Fields) -> Future[Fields]:
        return self._thread.submit(lambda core: core.request(kind, self.name, **fields))

    def _flush(self) -> Future[Fields]:
        self._check_sender()
        self._partial_sample = b""

        def flush(core: ClientCore) -> Future[Fields]:
            sequence = 0 if self._core.stream is None else self._core.stream.flush()
            fields = {"token": self._core.token, "sequence": sequence}
            return core.request("flush-session", self.name, **fields)

        return self._thread.submit(flush)

    def _close(self) -> Future[Fields]:
        return self._request("close-session", {"token": self._core.token})

    def _subscribe(
        self,
        classes: tuple[type[Result], ...],
        shape_set: str,
        keep_all: bool,
        on_result: Callable[[Any], None] | None = None,
    ) -> tuple[Inbox, Callable[[], None], Future[None]]:
        """Start a subscription.

        Return its inbox, a function that ends it, and a future that is done when it is in effect.
        """
        check_results(classes, shape_set)
        thread, core = self._thread, self._core
        inbox = Inbox(MAX_UNREAD_RESULTS if core.is_paced and not keep_all else None)
        subscription = Subscription(core, classes, shape_set, inbox, on_result)
        thread.call(lambda: core.subscribe(subscription))
        inbox.errors = core.errors
        close = partial(thread.call, lambda: core.unsubscribe(subscription))
        return inbox, close, subscription.joined

    def _join_error(self) -> KouxingError:
        """Return the error for a subscription that is not confirmed."""
        endpoints = [self._core.endpoints.get(name, "") for name in ("phones", "faps")]
        addresses = sorted({endpoint.partition(" ")[0] for endpoint in endpoints if endpoint})
        return KouxingError(
            f"{' or '.join(addresses)} does not confirm the subscription; run 'kouxing doctor' on"
            " this machine to find out why"
        )

    def _request_shapes(self, name: str) -> Future[Fields] | None:
        """Request a set of blendshapes, unless the session has it already."""
        if not name or name in (self._options or {}).get("face", {}).get("shapes", ()):
            return None
        return self._request("set-face", {"face": {"shapes": [name]}})

    def _subscribe_events(self) -> tuple[Inbox, Callable[[], None]]:
        """Return an inbox, and the function that closes it."""
        thread, core = self._thread, self._thread.core
        inbox = Inbox(MAX_UNREAD_EVENTS)
        thread.call(lambda: core.add_inbox(self._core, inbox))
        return inbox, lambda: thread.call(lambda: core.remove_inbox(self._core, inbox))

    def _check(self) -> None:
        """Raise the oldest error since the last call."""
        self._check_open()
        if self._core.errors:
            raise self._core.errors.popleft()

    def _check_unfinished(self) -> None:
        if self._has_finished:
            raise KouxingError("finish() has ended the audio of this session; open another session")

    def _check_open(self) -> None:
        if self._core.has_ended:
            raise self._core.failure or KouxingError("the session is closed")

    def _has_room(self) -> bool:
        return self._num_unacknowledged() < MAX_UNACKNOWLEDGED_MESSAGES

    def _can_push(self) -> bool:
        return self._core.has_ended or bool(self._core.errors) or self._has_room()

    def _is_delivered(self) -> bool:
        return self._core.has_ended or not self._has_finished or self._num_unacknowledged() == 0

    def _num_unacknowledged(self) -> int:
        stream = self._core.stream
        if stream is None:
            return 0
        return self._num_added - stream.sequence + stream.num_unacknowledged  # queued and sent


class BaseResults:
    """Results or events of one session. After ``close()``, no more arrive."""

    def __init__(self, inbox: Inbox, close: Callable[[], None]) -> None:
        self._inbox = inbox
        self._signal = inbox.signal
        self.close = close

    @property
    def has_ended(self) -> bool:
        """Whether the session's last frame has arrived, or the session is closed."""
        return self._inbox.has_ended

    @property
    def num_missed(self) -> int:
        """Minimum number of frames and phones that were published but did not arrive."""
        return self._inbox.num_missed

    def _has_results(self) -> bool:
        return self._inbox.has_ended or bool(self._inbox.messages)

    def _take(self) -> Any:
        """Return the next result, or None if none is left."""
        with contextlib.suppress(IndexError):
            return self._inbox.messages.popleft()
        if self._inbox.failure is not None:
            raise self._inbox.failure
        return None

    def _take_or_fail(self) -> Any:
        """Return the next result, or None; at the end, raise an error that no push has raised."""
        result = self._take()
        if result is None and self._inbox.has_ended and self._inbox.errors:
            raise self._inbox.errors.popleft()
        return result
