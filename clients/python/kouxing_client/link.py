"""The connection to control, and the thread that all of a client's connections share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import zmq

from kouxing_client.errors import KouxingError
from kouxing_client.keys import Key
from kouxing_client.messages import Fields, decode, encode, topic
from kouxing_client.session_link import SessionLink, refused
from kouxing_client.sockets import Signal, Sockets, new_future, send

RETRY_S = 1.0  # between requests that are not answered
TICK_S = 0.05
BUSY_TICK_S = 0.005  # while a socket takes no more audio
WATCHED = ("event", "session-moved")  # what control publishes of a session


@dataclass
class _Request:
    parts: list[bytes]
    answer: Future[Fields]
    end_s: float
    retry_s: float = 0.0


class Link:
    """Runs the thread, sends requests to control, and knows the sessions; for any thread.

    Parameters
    ----------
    control
        Address of control, ``tcp://HOST:PORT``.
    key
        Who asks; None: nothing is encrypted.
    timeout_s
        Time for an answer.
    make_signal
        Makes what wakes who waits for a session or for results.

    Raises
    ------
    KouxingError
        If the address is none.
    """

    def __init__(
        self, control: str, key: Key | None, timeout_s: float, make_signal: Callable[[], Signal]
    ) -> None:
        self._control = control
        self._timeout_s = timeout_s
        self._sockets = Sockets(key, make_signal)
        self._requests: dict[str, _Request] = {}
        self._sessions: dict[str, SessionLink] = {}
        self._events: zmq.Socket[bytes] | None = None
        self._is_stopping = False
        endpoint = control if key is None else f"{control} {key.control}"
        self._commands = self._sockets.connect(zmq.DEALER, [endpoint], self._on_command)
        self._thread = threading.Thread(target=self._run, name="kouxing-client", daemon=True)
        self._thread.start()

    def request(self, kind: str, session: str = "", **fields: object) -> Future[Fields]:
        """Ask control for something; the future has the answer's fields, or ``Refused``."""
        answer = new_future()
        name = f"{id(answer):x}-{time.monotonic_ns():x}"
        parts = encode(kind, session, {**fields, "request": name})
        request = _Request(parts, answer, time.monotonic() + self._timeout_s)

        def ask() -> None:
            self._requests[name] = request

        self._sockets.call(ask)
        return answer

    def open(self, options: Fields) -> Future[SessionLink]:
        """Open a session; the options are the fields of ``open-session``."""
        asked = self.request("open-session", **options)
        return _then(asked, lambda opened: self._add(SessionLink(self._sockets, opened, options)))

    def follow(self, name: str) -> Future[SessionLink]:
        """Follow a session that another program opened; an empty name: the newest."""
        asked = self.request("status-request", name)
        return _then(asked, lambda report: self._add(_newest(self._sockets, report)))

    def forget(self, session: SessionLink) -> Future[None]:
        """Close all that is connected to a session."""
        ended = new_future()

        def end() -> None:
            session.end(None)
            ended.set_result(None)

        self._sockets.call(end)
        return ended

    def close(self) -> None:
        """End the thread and close every socket."""
        self._sockets.call(self._stop)
        self._thread.join()

    # --- what follows is the thread's

    def _stop(self) -> None:
        self._is_stopping = True

    def _run(self) -> None:
        failure = KouxingError("the client is closed")
        try:
            while not self._is_stopping:
                self._step()
        except Exception as error:
            failure = KouxingError(f"the client failed: {error!r}")  # nobody must wait for ever
            failure.__cause__ = error
            raise
        finally:
            for request in self._requests.values():
                request.answer.set_exception(failure)
            for session in self._sessions.values():
                session.end(failure)
            self._sockets.close()

    def _step(self) -> None:
        is_busy = any(session.is_blocked for session in self._sessions.values())
        self._sockets.step(BUSY_TICK_S if is_busy else TICK_S)
        now_s = time.monotonic()
        for name, request in list(self._requests.items()):
            if now_s > request.end_s:
                text = (
                    f"control at {self._control} does not answer; does it run, and allow this key?"
                )
                self._requests.pop(name).answer.set_exception(KouxingError(text))
            elif now_s >= request.retry_s:
                request.retry_s = now_s + RETRY_S
                send(self._commands, request.parts)
        for session in list(self._sessions.values()):
            session.step(now_s)
            if session.is_over:
                self._remove(session)

    def _add(self, session: SessionLink) -> SessionLink:
        if self._events is None:
            endpoints = [session.endpoints["events"]]
            self._events = self._sockets.connect(zmq.SUB, endpoints, self._on_event)
        for kind in WATCHED:
            self._events.setsockopt(zmq.SUBSCRIBE, topic(kind, session.name))
        self._sessions[session.name] = session
        session.connect()
        return session

    def _remove(self, session: SessionLink) -> None:
        del self._sessions[session.name]
        if self._events is not None:
            for kind in WATCHED:
                self._events.setsockopt(zmq.UNSUBSCRIBE, topic(kind, session.name))

    def _on_command(self, parts: list[bytes]) -> None:
        if (message := decode(parts)) is None:
            return
        kind, fields = message
        if kind == "session-moved":
            self._on_moved(fields)
        elif kind == "error" and fields.get("code") == "bad-message":  # it says not which
            for request in self._requests.values():
                request.answer.set_exception(refused(fields))
            self._requests.clear()
        elif asked := self._requests.pop(str(fields.get("request")), None):
            if kind == "error":
                asked.answer.set_exception(refused(fields))
            else:
                asked.answer.set_result(fields)

    def _on_event(self, parts: list[bytes]) -> None:
        if (message := decode(parts)) is None:
            return
        kind, fields = message
        if kind == "session-moved":
            self._on_moved(fields)
        elif fields.get("name") == "session-closed" and fields["session"] in self._sessions:
            self._sessions[fields["session"]].close_soon(str(fields.get("detail")))

    def _on_moved(self, fields: Fields) -> None:
        if session := self._sessions.get(fields["session"]):
            session.move(fields)


def _then(asked: Future[Fields], make: Callable[[Fields], Any]) -> Future[Any]:
    """Return the future of what the thread makes of an answer."""
    made = new_future()

    def pass_on(answer: Future[Fields]) -> None:
        try:
            made.set_result(make(answer.result()))
        except Exception as error:
            made.set_exception(error)

    asked.add_done_callback(pass_on)
    return made


def _newest(sockets: Sockets, report: Fields) -> SessionLink:
    """Return the newest session of a ``status-report``."""
    sessions = [each for each in report["sessions"] if each["state"] == "open"]
    if not sessions:
        raise KouxingError("there is no session to follow")
    newest = min(sessions, key=lambda each: float(each["age_s"]))
    provided = {}
    for service in report["services"]:
        provided.update(service["endpoints"])
    endpoints = {**newest["endpoints"], "events": provided["events"]}
    return SessionLink(sockets, {**endpoints, "session": newest["session"], "epoch": 0}, None)
