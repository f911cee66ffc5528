"""Sends the face of a running session to other programs until the user interrupts."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterable

import numpy as np
from kouxing_client import Client, FapFrame, KouxingError, Results, Session
from kouxing_client.core import newest_session
from kouxing_client.messages import Fields

from kouxing.services.senders.sender_pool import SenderPool
from kouxing.services.senders.target import Target
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.command.terminal import print_message
from kouxing.shared.interrupt import catch_interrupt, install_interrupt_handler

SEARCH_PERIOD_S = 0.2
STEP_S = 0.05


def send_to(targets: Iterable[Target], session: str, control: str, *, idle_motion: bool) -> None:
    """Send the frames of a session; without a name, always of the newest session.

    While there are no frames, the face at rest is sent, with ``idle_motion`` if set. Raises
    ``UserError`` if control does not answer, or there are too many targets.
    """
    install_interrupt_handler()  # a background shell ignores SIGINT
    with (
        connect_client(control) as client,
        contextlib.closing(SenderPool(_report, idle_motion=idle_motion)) as senders,
        catch_interrupt(),
    ):
        open_sessions = [state.session for state in client.status().sessions]
        for target in {target.key: target for target in targets}.values():
            senders.start(target)
            print_message(f"sending {target.contents} to {target.url}; press Ctrl-C to stop")
            if target.expression_hint:
                print_message(f"{target.url}: {target.expression_hint}")
        if session and session not in open_sessions:
            others = ", ".join(open_sessions) or "none"
            print_message(f"waiting for session {session} to open (open sessions: {others})")
        with _SessionFinder(session, client, senders) as search:
            _send_frames(search, client, senders)


class _SessionFinder:
    """Asks control for the session to follow, in a thread because answers may take long.

    The targets' face at rest shows the expressions that control reports.
    """

    def __init__(self, session: str, client: Client, senders: SenderPool) -> None:
        self.newest: Fields | None = None  # name and id of the session that was found last
        self._session = session
        self._client = client
        self._senders = senders
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _SessionFinder:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._client.close()  # ends a request that control does not answer
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(SEARCH_PERIOD_S):
            with contextlib.suppress(KouxingError):  # control restarts, or no session is open
                status = self._client.status()
                face = status.resting_face
                if face.get("expressions") is not None:
                    self._senders.express(face["expressions"], face["hold_s"])
                self.newest = newest_session(status, self._session)


def _send_frames(search: _SessionFinder, client: Client, senders: SenderPool) -> None:
    """Send the frames of the session that was found last. Does not return."""
    followed = ""  # id of the followed session
    session: Session | None = None
    frames: Results[FapFrame] | None = None
    while True:
        newest = search.newest
        if newest is not None and newest["session_id"] != followed:
            if session is not None:
                session.close()
            followed = ""
            with contextlib.suppress(KouxingError):  # already closed, or control restarts
                session = client.follow(newest["session"])
                frames = session.frames()
                print_message(f"following session {newest['session']}")
                followed = newest["session_id"]
        frame: FapFrame | None = None
        with contextlib.suppress(KouxingError):  # the session was closed before its last frame
            frame = None if frames is None else frames.get(STEP_S)
        if frame is not None:
            senders.show(frame.time_s, np.array(frame.values, np.float32))
        elif frames is None or frames.has_ended:
            time.sleep(STEP_S)


def _report(url: str, problem: str) -> None:
    print_message(f"{url}: {problem or 'sending frames again'}")
