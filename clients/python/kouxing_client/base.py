"""What plain and asynchronous clients share: arguments, formats, and when to go on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

from kouxing_client.audio import SAMPLE_BYTES, pieces, to_pcm
from kouxing_client.errors import KouxingError
from kouxing_client.keys import Key, find_key
from kouxing_client.link import Link
from kouxing_client.messages import Fields, Result
from kouxing_client.resend import END_OF_AUDIO
from kouxing_client.session_link import SessionLink
from kouxing_client.sockets import Signal
from kouxing_client.subscription import Subscription

CONTROL = "tcp://127.0.0.1:5550"
CHUNK_BYTES = 32_000  # of one message at most
MAX_UNACKNOWLEDGED = 1000  # messages; then whoever sends waits


class BaseClient:
    """A connection to a running system.

    Parameters
    ----------
    control
        Address of control; else ``$KOUXING_CONTROL``, else ``tcp://127.0.0.1:5550``.
    key
        Who asks; else the user's own (``find_key``).
    insecure
        The system is one with ``insecure = true``: nothing is encrypted.
    timeout_s
        Time for an answer.

    Raises
    ------
    KouxingError
        If there is no key, or the address is none.
    """

    _make_signal: Callable[[], Signal]

    def __init__(
        self,
        control: str | None = None,
        *,
        key: Key | None = None,
        insecure: bool = False,
        timeout_s: float = 10.0,
    ) -> None:
        control = control or os.environ.get("KOUXING_CONTROL") or CONTROL
        self._link = Link(
            control, None if insecure else key or find_key(), timeout_s, type(self)._make_signal
        )


class BaseSession:
    """One session: audio goes in, if this program opened it, and results come out.

    What is lost on the way is sent again, and the results follow when the session moves to another
    process. To leave it as a context manager closes it.
    """

    def __init__(self, link: Link, session: SessionLink, options: Fields | None) -> None:
        self._link = link
        self._session = session
        self._options = options
        self._has_finished = False

    @property
    def name(self) -> str:
        """Its name."""
        return self._session.name

    def _add_shapes(self, name: str) -> Future[Fields] | None:
        """Ask for a set of blend shapes, unless it is there already."""
        if not name or name in self._session.endpoints.get("shapes", {}):
            return None
        return self._link.request("add-shapes", self.name, shapes=[name])

    def _chunks(self, audio: Any) -> Iterator[tuple[bytes, int]]:
        """Yield messages of PCM, and how many samples of each channel they have."""
        options = self._opened()
        pcm = to_pcm(audio, options["encoding"])
        frame_bytes = SAMPLE_BYTES[options["encoding"]] * options["num_channels"]
        if len(pcm) % frame_bytes:
            raise KouxingError(f"{len(pcm)} bytes are not whole samples of {frame_bytes} bytes")
        for piece in pieces(pcm, CHUNK_BYTES):
            yield piece, len(piece) // frame_bytes

    def _opened(self) -> Fields:
        if self._options is None:
            raise KouxingError("another program speaks in this session")
        return self._options

    def _add(self, pcm: bytes, num_frames: int) -> None:
        self._check()
        self._session.add("audio-chunk", num_frames, pcm=pcm)

    def _finish(self) -> None:
        self._opened()
        self._check()
        self._has_finished = True
        self._session.add(END_OF_AUDIO)

    def _flush(self) -> Future[Fields]:
        self._opened()
        self._session.flush()
        return self._link.request("flush-session", self.name, token=self._session.token)

    def _close(self) -> Future[Fields]:
        return self._link.request("close-session", self.name, token=self._session.token)

    def _check(self) -> None:
        """Raise what has gone wrong since the last call."""
        if self._session.is_over:
            raise self._session.failure or KouxingError("the session is closed")
        if self._session.errors:
            raise self._session.errors.popleft()

    def _has_room(self) -> bool:
        has_news = self._session.is_over or bool(self._session.errors)  # which are raised then
        return has_news or self._num_waiting() < MAX_UNACKNOWLEDGED

    def _is_delivered(self) -> bool:
        return self._session.is_over or not self._has_finished or self._num_waiting() == 0

    def _num_waiting(self) -> int:
        line = self._session.line
        return 0 if line is None else self._session.num_added - line.acknowledged


class BaseResults:
    """Results of one session."""

    def __init__(self, session: SessionLink, subscription: Subscription) -> None:
        self._session = session
        self._subscription = subscription

    def close(self) -> None:
        """Take no more."""
        self._session.unsubscribe(self._subscription)

    def _has_news(self) -> bool:
        return self._subscription.is_over or self._subscription.has_results

    def _take(self) -> Result | None:
        """Return the next result; None if none is there.

        Raises
        ------
        KouxingError
            If the session failed before its last face.
        """
        found = self._subscription.take()
        if found is None and self._subscription.is_over and self._subscription.failure:
            raise self._subscription.failure
        return found


def open_fields(
    name: str,
    sample_rate_hz: int,
    num_channels: int,
    encoding: str,
    shapes: Sequence[str],
    options: Mapping[str, object],
) -> Fields:
    """Return the fields of ``open-session``."""
    if encoding not in SAMPLE_BYTES:
        raise KouxingError(f"encoding must be one of {', '.join(SAMPLE_BYTES)}")
    return {
        "session": name,
        "sample_rate_hz": sample_rate_hz,
        "num_channels": num_channels,
        "encoding": encoding,
        **({"shapes": list(shapes)} if shapes else {}),
        **options,
    }
