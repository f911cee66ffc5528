"""The client for programs without an event loop: calls block."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import TimeoutError as FutureTimeout
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from kouxing_client.base import (
    LAST_ANSWER_S,
    BaseClient,
    BaseResults,
    BaseSession,
    FaceSettings,
    open_fields,
)
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.messages import Event, FapFrame, Fields, Phone, Result, Shapes, Status

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T", bound=Result | Event)


class ThreadSignal:
    """Wakes threads."""

    def __init__(self) -> None:
        self._condition = threading.Condition()

    def notify(self) -> None:
        """Wake all waiting threads."""
        with self._condition:
            self._condition.notify_all()

    def wait(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until a condition holds; return whether it does."""
        with self._condition:
            return self._condition.wait_for(condition, timeout_s)


class Client(BaseClient):
    """A connection to a running system; ``BaseClient`` describes the parameters.

    All requests raise ``Refused`` if control refuses, and ``KouxingError`` if it does not answer.
    """

    _make_signal = ThreadSignal

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections; control closes sessions that are left open a minute later."""
        self._thread.close()

    def open_session(
        self,
        name: str = "",
        *,
        sample_rate_hz: int = 16000,
        num_channels: int = 1,
        encoding: str = "s16le",
        shapes: Sequence[str] = (),
        **options: object,
    ) -> Session:
        """Open a session to send audio to.

        Parameters
        ----------
        name
            Session name. If empty, control chooses one.
        sample_rate_hz, num_channels
            8000 to 48000 Hz, 1 or 2 channels.
        encoding
            ``s16le`` or ``f32le``, of bytes that are pushed and on the wire.
        shapes
            Sets of blend shapes to publish from the first frame on: ``arkit``, ``oculus``, ``vrm``.
        options
            Other fields of ``open-session``, such as ``paced=False`` for audio that arrives faster
            than real time, or ``language="de"``.
        """
        fields = open_fields(name, sample_rate_hz, num_channels, encoding, shapes, options)
        core = self._thread.submit(lambda core: core.open_session(fields)).result()
        return Session(self._thread, core, fields)

    def follow(self, name: str = "", *, paced: bool = True) -> Session:
        """Follow a session that another program opened; if the name is empty, the newest one.

        If ``paced`` is set, old frames are dropped after this process was suspended, as is right
        for a face that is shown live. Otherwise no result is dropped, however late it is.
        """
        core = self._thread.submit(lambda core: core.follow(name, is_live=paced)).result()
        return Session(self._thread, core, None)

    def status(self, session: str = "") -> Status:
        """Return the state of all services and sessions, or of one session and its services."""
        return self._thread.submit(lambda core: core.status(session)).result()

    def set_face(self, session: str, **settings: Unpack[FaceSettings]) -> None:
        """Change the face of any session; the keywords are those of ``FaceSettings``."""
        self.request("set-face", session, face=settings)

    def request(self, kind: str, session: str = "", **fields: object) -> Fields:
        """Send any request of PROTOCOL.md; return the fields of the answer."""
        return self._request(kind, session, fields).result()


class Session(BaseSession):
    """One session; ``BaseSession`` describes what it does by itself."""

    _signal: ThreadSignal

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def push(self, audio: Any, timeout_s: float | None = None) -> None:
        """Send audio, and wait while too much of it is on its way.

        Parameters
        ----------
        audio
            Bytes of PCM in the session's encoding, of any length, or numbers (16-bit integers, or
            floats within ±1): a list, an ``array`` or a NumPy array of shape ``(n,)`` or
            ``(n, channels)``.
        timeout_s
            How long to wait until the recognizer takes more audio; None: without limit.

        Raises
        ------
        Refused
            If the recognizer rejected earlier audio; the session continues.
        KouxingError
            If the session is over, another program opened it, or the time limit has passed.
        """
        for pcm, num_frames in self._chunks(audio):
            if not self._signal.wait(self._can_push, timeout_s):
                raise KouxingError(
                    f"the recognizer has accepted no audio for {timeout_s:g} s; check that it runs"
                )
            if not self._has_room():
                self._check()
            self._add(pcm, num_frames)

    def finish(self) -> None:
        """End the audio; results continue until the last face. Raises as ``push``."""
        self._finish()

    def flush(self) -> None:
        """Interrupt: audio not yet shown is dropped, and the face returns to rest."""
        self._flush().result()

    def set_face(self, **settings: Unpack[FaceSettings]) -> None:
        """Change the face, as ``Client.set_face``."""
        self._request("set-face", {"face": settings}).result()

    def close(self) -> None:
        """Close the session if this program opened it, and all its connections."""
        if self._core.is_over:
            return
        if self._options is not None:
            self._signal.wait(self._is_delivered, LAST_ANSWER_S)
            with contextlib.suppress(Refused):  # it is closed already
                self._close().result()
        self._thread.forget(self._core).result()

    def frames(self) -> Results[FapFrame]:
        """Return the FAP frames from now on; raises ``KouxingError`` if the session is over."""
        return self._join((FapFrame,))

    def phones(self) -> Results[Phone]:
        """Return the phones from now on; each arrives at least twice. Raises as ``frames``."""
        return self._join((Phone,))

    def shapes(self, name: str) -> Results[Shapes]:
        """Return the weights of a set of blend shapes from now on; raises as ``frames``."""
        return self._join((Shapes,), name)

    def results(
        self,
        *classes: type[Result],
        shapes: str = "",
        keep_all: bool = False,
        on_result: Callable[[Any], None] | None = None,
    ) -> Results[Any]:
        """Return results of several classes from now on; raises as ``frames``.

        A call in the first 10 s after the session opens or moves also returns the results since
        that moment.

        Parameters
        ----------
        shapes
            Name of the set of blend shapes, if the classes include ``Shapes``.
        keep_all
            Whether all unread results of a live session are kept, not only the newest 100.
        on_result
            The client's thread calls this with each result, instead of keeping it.
        """
        return self._join(classes, shapes, keep_all, on_result)

    def events(self) -> Results[Event]:
        """Return control's events about the session from now on, even after it is closed."""
        return Results(*self._read_events())

    def _join(
        self,
        classes: tuple[type[Result], ...],
        shape_set: str = "",
        keep_all: bool = False,
        on_result: Callable[[Any], None] | None = None,
    ) -> Results[Any]:
        inbox, close, joined = self._subscribe(classes, shape_set, keep_all, on_result)
        try:
            joined.result(self._thread.timeout_s)
        except FutureTimeout:
            raise self._not_joined() from None
        if added := self._add_shapes(shape_set):
            added.result()
        return Results(inbox, close)


class Results(BaseResults, Generic[T]):
    """Results of one session; iteration ends with the session's last face."""

    _signal: ThreadSignal

    def __iter__(self) -> Results[T]:
        return self

    def __next__(self) -> T:
        result = self.get()
        if result is None:
            raise StopIteration
        return result

    def get(self, timeout_s: float | None = None) -> T | None:
        """Return the next result; None at the end, or if none arrives in time.

        Raises
        ------
        KouxingError
            If the session failed before its last face.
        """
        self._signal.wait(self._has_news, timeout_s)
        return cast("T | None", self._take())

    def available(self, timeout_s: float = 0.0) -> Iterator[T]:
        """Yield the results that have arrived, waiting for the first one; raises as ``get``."""
        while (result := self.get(timeout_s)) is not None:
            yield result
            timeout_s = 0.0
