"""The client for plain programs: calls wait."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar, cast

from kouxing_client.base import BaseClient, BaseResults, BaseSession, open_fields
from kouxing_client.errors import Refused
from kouxing_client.link import Link
from kouxing_client.messages import FapFrame, Fields, Phone, Result, Shapes
from kouxing_client.session_link import SessionLink
from kouxing_client.subscription import Subscription

LAST_ANSWER_S = 2.0  # for the end of the audio to be acknowledged before a session is closed
Kind = TypeVar("Kind", bound=Result)


class PlainSignal:
    """Wakes threads."""

    def __init__(self) -> None:
        self._condition = threading.Condition()

    def notify(self) -> None:
        """Wake all who wait."""
        with self._condition:
            self._condition.notify_all()

    def wait(self, condition: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until a condition holds; return whether it does."""
        with self._condition:
            return self._condition.wait_for(condition, timeout_s)


class Client(BaseClient):
    """A connection to a running system; ``BaseClient`` has the parameters."""

    _make_signal = PlainSignal

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections; control closes sessions that are left open a minute later."""
        self._link.close()

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
        """Open a session, to send audio to it.

        Parameters
        ----------
        name
            Of the session; empty: control chooses one.
        sample_rate_hz, num_channels
            Of the audio: 8000 to 48000, and 1 or 2.
        encoding
            ``s16le`` or ``f32le``: of bytes that are pushed, and what goes over the wire.
        shapes
            Sets of blend shapes that are wanted from the first frame on: ``arkit``, ``oculus``,
            ``vrm``. (Others may be asked for later.)
        options
            Other fields of ``open-session``, such as ``paced=False``: audio does not come in real
            time, but as fast as it is taken.

        Raises
        ------
        Refused
            If control refuses.
        KouxingError
            If it does not answer.
        """
        fields = open_fields(name, sample_rate_hz, num_channels, encoding, shapes, options)
        return Session(self._link, self._link.open(fields).result(), fields)

    def follow(self, name: str = "") -> Session:
        """Follow a session that another program has opened; an empty name: the newest.

        Raises
        ------
        Refused
            If there is no session of this name.
        KouxingError
            If there is no session at all, or control does not answer.
        """
        return Session(self._link, self._link.follow(name).result(), None)

    def request(self, kind: str, session: str = "", **fields: object) -> Fields:
        """Send any request of PROTOCOL.md, such as ``express``; return the answer's fields.

        Raises
        ------
        Refused
            If control refuses.
        KouxingError
            If it does not answer.
        """
        return self._link.request(kind, session, **fields).result()


class Session(BaseSession):
    """One session; ``BaseSession`` says what it does by itself."""

    def __init__(self, link: Link, session: SessionLink, options: Fields | None) -> None:
        super().__init__(link, session, options)
        self._signal = cast(PlainSignal, session.signal)

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def push(self, audio: Any) -> None:
        """Send audio; it waits while much is on its way.

        Parameters
        ----------
        audio
            Bytes of PCM in the session's encoding, or numbers (integers of 16 bits, or floats
            within ±1): a list, an ``array``, a NumPy array; of shape ``(n,)`` or ``(n, channels)``.

        Raises
        ------
        Refused
            If the recognizer could not use audio that was sent before; the session goes on.
        KouxingError
            If the session is over, or another program's.
        """
        for pcm, num_frames in self._chunks(audio):
            self._signal.wait(self._has_room)
            self._add(pcm, num_frames)

    def finish(self) -> None:
        """Say that no more audio comes; the results go on to the last face. Raises as ``push``."""
        self._finish()

    def flush(self) -> None:
        """Interrupt: audio not yet shown is dropped, and the face returns to rest."""
        self._flush().result()

    def close(self) -> None:
        """Close the session, if this program opened it, and all that is connected to it."""
        if not self._session.is_over and self._options is not None:
            self._signal.wait(self._is_delivered, LAST_ANSWER_S)
            with contextlib.suppress(Refused):  # it is closed already
                self._close().result()
        self._link.forget(self._session).result()

    def frames(self) -> Results[FapFrame]:
        """Return the FAP frames from here on; raises ``KouxingError`` if the session is over."""
        return self._subscribe((FapFrame,))

    def phones(self) -> Results[Phone]:
        """Return the phones from here on, as ``frames``; each comes at least twice."""
        return self._subscribe((Phone,))

    def shapes(self, name: str) -> Results[Shapes]:
        """Return the weights of a set of blend shapes from here on, as ``frames``."""
        return self._subscribe((Shapes,), name)

    def results(self, *kinds: type[Result], shapes: str = "") -> Results[Result]:
        """Return results of several kinds from here on, as ``frames``."""
        return self._subscribe(kinds, shapes)

    def _subscribe(self, kinds: tuple[type[Result], ...], shapes: str = "") -> Results[Any]:
        subscription = self._session.subscribe(kinds, shapes)
        subscription.joined.result()
        if added := self._add_shapes(shapes):
            added.result()
        return Results(self._session, subscription)


class Results(BaseResults, Generic[Kind]):
    """Results of one session; iteration ends with the session's last face."""

    def __init__(self, session: SessionLink, subscription: Subscription) -> None:
        super().__init__(session, subscription)
        self._signal = cast(PlainSignal, subscription.signal)

    def __iter__(self) -> Results[Kind]:
        return self

    def __next__(self) -> Kind:
        found = self.get()
        if found is None:
            raise StopIteration
        return found

    def get(self, timeout_s: float | None = None) -> Kind | None:
        """Return the next result; None at the end, or if none came in time.

        Raises
        ------
        KouxingError
            If the session failed before its last face.
        """
        self._signal.wait(self._has_news, timeout_s)
        return cast("Kind | None", self._take())
