"""Sends the face of a running session to other programs, until the user interrupts."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterable

import numpy as np

from kouxing.services.cli.follow import OPEN_POLL_S, find_session
from kouxing.services.senders.senders import Senders
from kouxing.services.senders.target import Target
from kouxing.shared.client import Client
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.follower import PollingLoop, SessionFollower
from kouxing.shared.terminal import print_message
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.session import SessionState

STEP_S = 0.05
SEARCH_LIMIT_S = 1.0


def send_to(targets: Iterable[Target], session: str, control: str, idle_motion_seed: int) -> None:
    """Send the frames of a session.

    Parameters
    ----------
    session
        Its name; empty: the newest at any time.
    idle_motion_seed
        Of the face that is sent while there are no frames.

    Raises
    ------
    UserError
        If control does not answer, or there are too many targets.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it
    with (
        Client(control) as client,
        contextlib.closing(Senders(idle_motion_seed, _report)) as senders,
        contextlib.suppress(KeyboardInterrupt),
    ):
        client.status()
        for target in targets:
            senders.start(target)
            print_message(f"sending {target.contents} to {target.url}; Ctrl-C ends")
        with _Search(session, control) as search:
            _follow(search, client, senders)


class _Search:
    """Asks control for the session to follow, in a thread: answers may take their time.

    Attributes
    ----------
    found
        What control said last, if there was one.
    """

    def __init__(self, session: str, control: str) -> None:
        self.found: SessionState | None = None
        self._session = session
        self._control = control
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Search:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        with Client(self._control, deadline_s=SEARCH_LIMIT_S) as client:
            while not self._ended.wait(OPEN_POLL_S):
                with contextlib.suppress(UserError):  # control may start again
                    self.found = find_session(self._session, client) or self.found


def _follow(search: _Search, client: Client, senders: Senders) -> None:
    """Send the frames of the session that was found last, for ever."""

    def accept(frame: FapFrame) -> None:
        values = np.frombuffer(frame.values, "<f4").astype(np.float32)
        senders.accept(to_seconds(frame.media_time), values)

    loop = PollingLoop(client.bus)
    follower: SessionFollower | None = None
    before: SessionState | None = None
    while True:
        found = search.found
        if found is not None and found is not before:
            if follower is None or before is None or _is_another(found, before):
                if follower is not None:
                    follower.close()
                follower = SessionFollower(loop, found.session, {FapFrame: accept})
                follower.start(0, found.endpoints)
                print_message(f"following session {found.session}")
            elif found.endpoints != before.endpoints:
                follower.start(0, found.endpoints)
            before = found
        loop.step(STEP_S)


def _is_another(session: SessionState, before: SessionState) -> bool:
    return session.session != before.session or session.age_s < before.age_s


def _report(url: str, problem: str) -> None:
    print_message(f"{url}: {problem or 'frames leave again'}")
