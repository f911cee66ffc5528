"""The blocking client."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import TimeoutError as FutureTimeout
from concurrent.futures import wait
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from kouxing_client.base import LAST_ANSWER_S, BaseClient, BaseResults, BaseSession
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.messages import Event, FapFrame, Fields, Phone, Result, Shapes, Status
from kouxing_client.options import FaceSettings, SessionOptions, face_fields, open_fields

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T", bound=Result | Event)


class Client(BaseClient):
    """A connection to a running system; ``BaseClient`` describes the parameters.

    All requests raise ``Refused`` if control rejects them, and ``KouxingError`` if control does not
    answer.
    """

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections, and sessions whose opening was interrupted, for example by Ctrl-C.

        After a minute, control closes other sessions that are still open.
        """
        self._thread.check_may_wait()
        try:
            wait(tuple(self._unused), LAST_ANSWER_S)
        finally:
            self._thread.close()

    def open_session(self, name: str = "", **options: Unpack[SessionOptions]) -> Session:
        """Open a session, to which this program can send audio.

        If the name is empty, control chooses one. ``SessionOptions`` lists the keywords.
        """
        fields = open_fields(name, options)
        opened = self._thread.submit(lambda core: core.open_session(fields))
        try:
            return Session(self._thread, opened.result(), fields)
        except BaseException:  # also Ctrl-C
            self._close_unused(opened)
            raise

    def follow(self, name: str = "", *, paced: bool = True) -> Session:
        """Follow a session that another program opened. An empty name selects the newest session.

        If ``paced`` is true and this process was stalled, outdated frames are dropped. Use this
        to show a live face. If ``paced`` is false, every result is delivered, even if it is late.
        """
        core = self._thread.submit(lambda core: core.follow(name, is_paced=paced)).result()
        return Session(self._thread, core, None)

    def status(self, session: str = "") -> Status:
        """Return the state of all services and sessions, or of one session and its workers."""
        return self._thread.submit(lambda core: core.status(session)).result()

    def set_face(self, session: str, **settings: Unpack[FaceSettings]) -> None:
        """Change the face of any session. ``FaceSettings`` lists the keywords."""
        self.request("set-face", session, face=face_fields(settings))

    def request(self, kind: str, session: str = "", **fields: object) -> Fields:
        """Send a request of PROTOCOL.md and return the fields of the answer."""
        return self._request(kind, session, fields).result()


class Session(BaseSession):
    """One session. ``BaseSession`` describes the common behavior."""

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def push(self, audio: Any, timeout_s: float | None = None) -> None:
        """Send audio. Block while too much audio is unacknowledged.

        Parameters
        ----------
        audio
            PCM bytes of any length in the session's encoding, or numbers (16-bit integers, or
            floats within ±1): a list, an ``array``, or a NumPy array of shape ``(n,)`` or
            ``(n, channels)``.
        timeout_s
            Maximum wait for the recognizer to accept more audio; None: no limit.

        Raises
        ------
        Refused
            If the recognizer rejected earlier audio; the session continues.
        KouxingError
            If the audio is not valid or has ended, the session has ended, another program opened
            it, or the wait timed out.
        """
        self._thread.check_may_wait()
        for pcm, num_samples in self._chunks(audio):
            if not self._signal.wait(self._can_push, timeout_s):
                raise KouxingError(
                    f"the recognizer has accepted no audio for {timeout_s:g} s; check that it runs"
                )
            if not self._has_room():
                self._check()
            self._add(pcm, num_samples)

    def finish(self) -> None:
        """End the audio. Results arrive until the last frame. Raises the errors of ``push``."""
        self._finish()

    def flush(self) -> None:
        """Interrupt the speech: drop audio that is not shown yet, and return the face to rest."""
        self._flush().result()

    def set_face(self, **settings: Unpack[FaceSettings]) -> None:
        """Change the face. ``FaceSettings`` lists the keywords."""
        self._request("set-face", {"face": face_fields(settings)}).result()

    def close(self) -> None:
        """Close the connections of the session, and the session if this program opened it."""
        if self._core.has_ended:
            return
        self._thread.check_may_wait()
        try:
            if self._options is not None:
                self._signal.wait(self._is_delivered, LAST_ANSWER_S)
                with contextlib.suppress(Refused):  # already closed
                    self._close().result()
        finally:
            self._thread.disconnect(self._core).result()

    def frames(self) -> Results[FapFrame]:
        """Subscribe to FAP frames. Raises ``KouxingError`` if the session has ended."""
        return self._join((FapFrame,))

    def phones(self) -> Results[Phone]:
        """Subscribe to phones; each arrives at least twice. Raises the errors of ``frames``."""
        return self._join((Phone,))

    def shapes(self, name: str) -> Results[Shapes]:
        """Subscribe to the weights of a blendshape set. Raises the errors of ``frames``."""
        return self._join((Shapes,), name)

    def results(
        self,
        *classes: type[Result],
        shapes: str = "",
        keep_all: bool = False,
        on_result: Callable[[Any], None] | None = None,
    ) -> Results[Any]:
        """Subscribe to results of several classes. Raises the errors of ``frames``.

        In the first 10 s after the session opens or moves, a subscription also returns the results
        since that time.

        Parameters
        ----------
        shapes
            Name of the blendshape set, if ``classes`` contains ``Shapes``.
        keep_all
            Keep all unread results of a live session instead of the newest 100.
        on_result
            Function that the client's thread calls with each result. Results are then not stored.
            The function must not wait. Of this client, it may call ``try_push``, ``skip``,
            ``finish`` and ``take_errors``; methods that wait for an answer raise ``KouxingError``.
        """
        return self._join(classes, shapes, keep_all, on_result)

    def events(self) -> Results[Event]:
        """Subscribe to control's events about the session, including those after it has closed."""
        return Results(*self._subscribe_events())

    def _join(
        self,
        classes: tuple[type[Result], ...],
        shape_set: str = "",
        keep_all: bool = False,
        on_result: Callable[[Any], None] | None = None,
    ) -> Results[Any]:
        self._thread.check_may_wait()
        inbox, close, joined = self._subscribe(classes, shape_set, keep_all, on_result)
        try:
            joined.result(self._thread.timeout_s)
            if added := self._request_shapes(shape_set):
                added.result()
        except FutureTimeout:
            close()
            raise self._join_error() from None
        except BaseException:  # also Ctrl-C
            close()
            raise
        return Results(inbox, close)


class Results(BaseResults, Generic[T]):
    """Results of one session. Iteration ends with the session's last frame.

    At the end, it raises any error about the audio that no ``push`` or ``finish`` has raised.
    """

    def __iter__(self) -> Results[T]:
        return self

    def __next__(self) -> T:
        while (result := self.get()) is None:
            if self.has_ended:  # otherwise another reader has taken the result
                raise StopIteration
        return result

    def get(self, timeout_s: float | None = None) -> T | None:
        """Return the next result, or None at the end or after the timeout.

        Raises
        ------
        KouxingError
            If the session failed before its last frame.
        Refused
            At the end, if the recognizer rejected audio and no ``push`` or ``finish`` raised it.
        """
        self._signal.wait(self._has_results, timeout_s)
        return cast("T | None", self._take_or_fail())

    def available(self, timeout_s: float = 0.0) -> Iterator[T]:
        """Wait for a result, then yield all that have arrived.

        Raises ``KouxingError`` if the session failed before its last frame. ``take_errors`` of the
        session returns errors about the audio.
        """
        self._signal.wait(self._has_results, timeout_s)
        while (result := self._take()) is not None:
            yield cast(T, result)
