"""The core of all clients, without I/O: requests to control, sessions and events."""

from __future__ import annotations

import contextlib
import math
import secrets
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from kouxing_client.connection_check import NO_LISTENER
from kouxing_client.errors import KouxingError, NotConnected, Refused
from kouxing_client.inbox import Inbox, new_future
from kouxing_client.messages import (
    Decoders,
    Event,
    Fields,
    ServiceState,
    SessionState,
    Status,
    decode,
    encode,
    kind_of,
    topic,
)
from kouxing_client.session_core import SILENT_S, SessionCore, refused

if TYPE_CHECKING:
    from kouxing_client.sockets import Connection, Sockets

RETRY_S = 1.0  # interval between attempts of an unanswered request
MAX_FAILED_OPENINGS = 100  # requests
WATCHED_TOPICS = ("event", "session-moved")  # topics that control publishes about a session
EVENTS = Decoders(Event)
T = TypeVar("T")
U = TypeVar("U")


@dataclass
class _Request:
    parts: list[bytes]
    answer: Future[Fields]
    end_s: float
    start_s: float  # then control must have started
    is_checked: bool = False  # whether the address was checked after ``start_s``
    retry_s: float = 0.0


class ClientCore:
    """Sends requests to control, and passes its messages to the sessions.

    For the parameters, see ``ClientThread``; ``control`` includes control's public key.
    """

    def __init__(self, sockets: Sockets, control: str, timeout_s: float, start_s: float) -> None:
        self.sessions: list[SessionCore] = []
        self._sockets = sockets
        self._control = control
        self._timeout_s = timeout_s
        self._start_s = start_s
        self._has_started = False  # control has sent something
        self._requests: dict[str, _Request] = {}
        # Newest requests that failed, but that control may still fulfill
        self._failed_openings: deque[str] = deque(maxlen=MAX_FAILED_OPENINGS)
        self._refused_s = math.inf  # when control started to reject this key
        self._is_diagnosing = False  # searching for the reason why control does not answer
        self._inboxes: dict[SessionCore, list[Inbox]] = {}
        self._events: Connection | None = None
        self._close_reason: KouxingError | None = None  # None while this client is open
        self._commands = self._connect()

    def request(self, kind: str, session: str = "", **fields: object) -> Future[Fields]:
        """Send a request to control; the future gets the answer's fields, or ``Refused``."""
        if self._close_reason is not None:
            answer = new_future()
            answer.set_exception(self._close_reason)
            return answer
        name = secrets.token_hex(8)
        parts = encode(kind, session, {**fields, "request": name})
        now_s = self._sockets.now_s
        request = self._requests[name] = _Request(
            parts, new_future(), now_s + self._timeout_s, now_s + self._start_s
        )
        self._send(request)
        return request.answer

    def status(self, session: str) -> Future[Status]:
        """Request the state of the system, or of one session and its services."""
        status, answer = Status(services=[], sessions=[]), new_future()

        def add_page(page: Future[Fields]) -> None:
            with forward_errors(answer):
                fields = page.result()
                status.services.extend(msgspec.convert(fields["services"], list[ServiceState]))
                status.sessions.extend(msgspec.convert(fields["sessions"], list[SessionState]))
                status.resting_face.update(fields.get("resting_face") or {})
                if fields.get("next"):
                    request_page(fields["next"])
                else:
                    answer.set_result(status)

        def request_page(after: int) -> None:
            self.request("status-request", session, after=after).add_done_callback(add_page)

        request_page(0)
        return answer

    def open_session(self, options: Fields) -> Future[SessionCore]:
        """Open a session; the options are the fields of ``open-session``."""
        is_paced = bool(options.get("paced", True))
        return map_future(
            self.request("open-session", **options),
            lambda opened: self._add(opened, options, is_paced=is_paced),
        )

    def follow(self, name: str, *, is_paced: bool) -> Future[SessionCore]:
        """Follow a session that another program opened; if the name is empty, the newest."""

        def add(status: Status) -> SessionCore:
            return self._add(newest_session(status, name), None, is_paced=is_paced)

        return map_future(self.status(""), add)  # with the endpoint of control's events

    def add_inbox(self, session: SessionCore, inbox: Inbox) -> None:
        """Pass a session's events to an inbox, even after the session has ended."""
        self._inboxes.setdefault(session, []).append(inbox)
        self._watch(session.name, on=True)
        if self._close_reason is not None:
            inbox.end(self._close_reason)

    def remove_inbox(self, session: SessionCore, inbox: Inbox) -> None:
        """Stop passing events to an inbox."""
        inboxes = self._inboxes.get(session, [])
        if inbox in inboxes:
            inboxes.remove(inbox)
            self._watch(session.name, on=False)
            if not inboxes:
                del self._inboxes[session]
        inbox.end(None)

    def tick(self) -> None:
        """Repeat requests and ask about silent sessions; call this regularly."""
        now_s = self._sockets.now_s
        has_failed = bool(self.sessions) and self._is_refused()
        for request in self._requests.values():
            has_failed |= now_s > request.end_s or self._needs_check(request)
            if request.retry_s <= now_s <= request.end_s:
                self._send(request)
        if has_failed and not self._is_diagnosing:
            self._is_diagnosing = True
            self._sockets.explain(self._control, self._fail_requests)
        for session in list(self.sessions):
            session.tick()
            if session.has_ended:
                self._remove(session)
            elif session.is_silent():
                self._locate(session)

    def close(self, failure: KouxingError) -> None:
        """End all sessions, and answer all requests, also later ones, with a failure."""
        self._close_reason, self._events = failure, None
        for request in self._requests.values():
            request.answer.set_exception(failure)
        self._requests.clear()
        for session in self.sessions:
            session.end(failure)
        for inboxes in self._inboxes.values():
            for inbox in inboxes:
                inbox.end(failure)

    def _connect(self) -> Connection:
        def set_refused(is_refused: bool) -> None:
            now_s = self._sockets.now_s
            self._refused_s = min(self._refused_s, now_s) if is_refused else math.inf

        return self._sockets.connect(self._control, self._on_command, on_refused=set_refused)

    def _send(self, request: _Request) -> None:
        request.retry_s = self._sockets.now_s + RETRY_S
        if not self._sockets.send(self._commands, request.parts):
            # Another program was at control's address: libzmq never reconnects that socket.
            self._sockets.close_connection(self._commands)
            self._commands = self._connect()
            self._sockets.send(self._commands, request.parts)

    def _is_refused(self) -> bool:
        """Return whether control has rejected this key for longer than a temporary penalty."""
        return self._sockets.now_s > self._refused_s + self._timeout_s

    def _needs_check(self, request: _Request) -> bool:
        """Return whether to check control's address: control should have started, but has not."""
        is_due = self._sockets.now_s > request.start_s
        return is_due and not request.is_checked and not self._has_started

    def _fail_requests(self, reason: str) -> None:
        """End requests without an answer, and all sessions if control rejects this key."""
        self._is_diagnosing = False
        failure = NotConnected(self._failure_text(reason))
        for name, request in list(self._requests.items()):
            is_unanswerable = self._needs_check(request) and reason == NO_LISTENER
            if self._sockets.now_s > request.end_s or is_unanswerable:
                self._requests.pop(name).answer.set_exception(failure)
                if kind_of(request.parts) == "open-session":
                    self._failed_openings.append(name)
            request.is_checked = self._sockets.now_s > request.start_s
        if self._is_refused():
            for session in self.sessions:
                session.end(failure)

    def _failure_text(self, reason: str) -> str:
        """Return an error text. ``reason`` says why control cannot be reached, or is empty."""
        address, _, key = self._control.partition(" ")
        if reason:
            return f"control at {address} does not answer: {reason}"
        if self._refused_s == math.inf:
            return f"control at {address} does not answer. Start it with 'kouxing run'"
        return f"control at {address} " + (
            "does not accept this key. If it belongs to another user, start your own with"
            " 'kouxing run'. If it is yours, restart it. If it runs on another machine, run"
            " 'kouxing keys add NAME --role client' there and copy the file here"
            if key
            else "rejects this client: 'insecure' is set here but not there, or its log says why"
        )

    def _add(self, opened: Fields, options: Fields | None, *, is_paced: bool) -> SessionCore:
        session = SessionCore(self._sockets, opened, options, is_paced=is_paced)
        if self._events is None:
            self._events = self._sockets.connect_events(opened["events"], self._on_event)
        self.sessions.append(session)
        self._watch(session.name, on=True)
        session.connect()
        return session

    def _remove(self, session: SessionCore) -> None:
        self.sessions.remove(session)
        if session.stream is not None and isinstance(session.failure, Refused):
            # the recognizer has rejected the audio, but control still has the session
            self.request("close-session", session.name, token=session.token)
        self._watch(session.name, on=False)

    def _watch(self, session: str, *, on: bool) -> None:
        if self._events is not None:
            topics = [topic(kind, session) for kind in WATCHED_TOPICS]
            self._sockets.set_topics(self._events, topics, on=on)

    def _locate(self, session: SessionCore) -> None:
        """Ask control where a silent session is: its ``session-moved`` may be lost."""
        now_s = self._sockets.now_s
        if now_s < session.last_located_s + SILENT_S:
            return
        session.last_located_s = now_s

        def on_status(answer: Future[Status]) -> None:
            try:
                state = newest_session(answer.result(), session.name)
            except Refused as refusal:
                if refusal.code == "unknown-session":
                    session.end(None)
                return
            except KouxingError:
                return  # control may restart
            if session.is_about(state["session"], state["session_id"]):
                session.set_endpoints({name: state[name] for name in ("phones", "faps")})
            else:
                session.end(None)  # another session has its name now

        self.status(session.name).add_done_callback(on_status)

    def _on_command(self, parts: list[bytes]) -> None:
        if (message := decode(parts)) is None:
            return
        self._has_started = True
        kind, fields = message
        if kind == "session-moved":
            self._on_moved(fields)
        elif fields.get("code") == "bad-message" and not fields.get("request"):
            # control cannot read the request's name, or is older
            for request in self._requests.values():
                request.answer.set_exception(refused(fields))
            self._requests.clear()
        else:
            self._on_answer(str(fields.get("request")), kind, fields)

    def _on_answer(self, name: str, kind: str, fields: Fields) -> None:
        if pending := self._requests.pop(name, None):
            if kind == "error":
                pending.answer.set_exception(refused(fields))
            else:
                pending.answer.set_result(fields)
        elif name in self._failed_openings:
            self._failed_openings.remove(name)
            if kind == "session-opened":  # nobody would use or close it
                self.request("close-session", fields["session"], token=fields["token"])

    def _on_event(self, parts: list[bytes]) -> None:
        if kind_of(parts) == "session-moved" and (message := decode(parts)) is not None:
            self._on_moved(message[1])
        event = EVENTS.decode(parts)
        if not isinstance(event, Event):
            return
        subject = event.session, event.session_id
        for session, inboxes in self._inboxes.items():
            for inbox in inboxes if session.is_about(*subject) else ():
                inbox.add(event)
        if event.name == "session-closed":
            for session in self._subjects(*subject):
                session.close_after_results(event.detail)

    def _on_moved(self, fields: Fields) -> None:
        for session in self._subjects(fields["session"], fields.get("session_id")):
            session.move(fields)

    def _subjects(self, name: str, session_id: str | None) -> list[SessionCore]:
        return [session for session in self.sessions if session.is_about(name, session_id)]


def newest_session(status: Status, name: str) -> Fields:
    """Return name and endpoints of the newest session of a name (if empty, of any name).

    Raises
    ------
    Refused
        If there is no such session.
    """
    sessions = [
        state
        for state in status.sessions
        if "faps" in state.endpoints and name in ("", state.session)
    ]
    if not sessions:
        text = f"there is no session {name!r}" if name else "there is no session to follow"
        raise Refused("unknown-session", text)
    newest = min(sessions, key=lambda state: state.age_s)
    endpoints: dict[str, str] = {}
    for service in status.services:
        endpoints.update(service.endpoints)
    return {
        **newest.endpoints,
        "events": endpoints.get("events", ""),
        "session": newest.session,
        "session_id": newest.session_id,
        "epoch": 0,
        "facts": msgspec.to_builtins(newest.facts),
    }


@contextlib.contextmanager
def forward_errors(future: Future[Any]) -> Iterator[None]:
    """Pass exceptions of the block to a future."""
    try:
        yield
    except Exception as error:
        future.set_exception(error)


def map_future(
    source: Future[T], convert: Callable[[T], U], target: Future[U] | None = None
) -> Future[U]:
    """Return ``target``, or a new future, that gets ``convert(result)`` of another future."""
    target = new_future() if target is None else target

    def on_answer(answer: Future[T]) -> None:
        with forward_errors(target):
            target.set_result(convert(answer.result()))

    source.add_done_callback(on_answer)
    return target
