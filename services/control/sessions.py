"""Sessions as control knows them; no sockets, so that every rule can be tested."""

from __future__ import annotations

import math
import secrets
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from services.control.registry import Refusal, Registry
from shared.keys import Peer
from shared.wire.control import Heartbeat, SessionState, StartSession
from shared.wire.session import ErrorCode, OpenSession, SessionMoved, SessionOpened

KEY_SHARE = 0.75  # of the sessions that one key may have open


@dataclass(slots=True)
class SessionRecord:
    """One session."""

    name: str
    token: str
    opening: OpenSession
    client: Peer  # on control's socket
    opened_s: float
    started_s: float  # when its services were last told to start it, or one was lost
    workers: dict[str, str]  # instance by endpoint
    endpoints: dict[str, str]  # address by endpoint
    language: str  # of the phones; empty if no worker states one
    delay_ms: float  # how much later than its sound a FAP frame is made
    lips: str  # the lip model that moves the mouth; empty if no worker states one
    waiting_for: set[str]  # instances that have not started it yet
    epoch: int = 1  # counts its placements
    announced: bool = False  # the client was told that it is open
    moved: bool = False  # placed again, and the client was not told yet
    speaking: bool = False
    next_sequence: int = 1  # of the first audio message that no recognizer is known to have
    resume_sequence: int = 0  # where a new recognizer begins; 0: it is the old one

    @property
    def start_request(self) -> str:
        """The request that its services confirm when they have started it."""
        return f"start-{self.name}-{self.epoch}"


class Sessions:
    """The open sessions, by name."""

    def __init__(self, registry: Registry, max_sessions: int) -> None:
        self._registry = registry
        self._max_sessions = max_sessions
        self._records: dict[str, SessionRecord] = {}

    def __iter__(self) -> Iterator[SessionRecord]:
        return iter(list(self._records.values()))

    def get(self, name: str) -> SessionRecord | None:
        """Return a session, None if there is none of that name."""
        return self._records.get(name)

    def open(self, opening: OpenSession, client: Peer, now_s: float) -> SessionRecord:
        """Place a new session.

        Raises
        ------
        Refusal
            The name is taken, there are too many sessions, of all or of the client's key, or a
            service is missing.
        """
        name = opening.session or f"s{secrets.token_hex(4)}"
        if name in self._records:
            raise Refusal(
                ErrorCode.SESSION_EXISTS, f"session {name!r} is open; choose another name"
            )
        if len(self._records) >= self._max_sessions:
            raise Refusal(
                ErrorCode.TOO_MANY_SESSIONS, f"{self._max_sessions} sessions are open already"
            )
        of_key = sum(record.client.key == client.key for record in self._records.values())
        if client.key and of_key >= math.ceil(KEY_SHARE * self._max_sessions):
            raise Refusal(
                ErrorCode.TOO_MANY_SESSIONS,
                f"{of_key} sessions of your key are open already; the rest is for other keys",
            )
        workers = self._registry.place({}, self._load())
        record = SessionRecord(
            name=name,
            token=secrets.token_urlsafe(24),
            opening=opening,
            client=client,
            opened_s=now_s,
            started_s=now_s,
            workers=workers,
            endpoints=self._registry.endpoints(workers),
            language=self._registry.language(workers.values()),
            delay_ms=self._registry.delay_ms(workers.values()),
            lips=self._registry.lips(workers.values()),
            waiting_for={*workers.values()} | self._registry.observers(),
        )
        self._records[name] = record
        return record

    def remove(self, record: SessionRecord) -> None:
        """Forget a session."""
        del self._records[record.name]

    def owned(self, session: str, token: str) -> SessionRecord:
        """Return a session whose token is given.

        Raises
        ------
        Refusal
            There is no such session, or the token is another's.
        """
        record = self.find(session)
        if not secrets.compare_digest(record.token.encode(), token.encode()):
            raise Refusal(ErrorCode.BAD_TOKEN, f"the token is not that of session {session!r}")
        return record

    def find(self, session: str) -> SessionRecord:
        """Return a session.

        Raises
        ------
        Refusal
            There is no such session.
        """
        record = self._records.get(session)
        if record is None:
            raise Refusal(
                ErrorCode.UNKNOWN_SESSION, f"there is no session {session!r}; open it first"
            )
        return record

    def participants(self, record: SessionRecord) -> set[str]:
        """Return the running services that take part: the session's workers and all observers."""
        workers = {instance for instance in record.workers.values() if instance in self._registry}
        return workers | self._registry.observers()

    def lost_workers(self, record: SessionRecord) -> list[str]:
        """Return the session's workers that do not run any more."""
        return sorted({i for i in record.workers.values() if i not in self._registry})

    def take_input(self, record: SessionRecord, heartbeat: Heartbeat) -> float:
        """Note how far a service is with the session's input; return for how long it had none."""
        state = heartbeat.sessions[record.name]
        if heartbeat.instance != record.workers["audio"]:
            return 0.0
        record.next_sequence = max(record.next_sequence, state.sequence + 1)
        return state.idle_s

    def replace(self, record: SessionRecord, now_s: float) -> bool:
        """Place a session again after workers were lost; return success."""
        kept = {name: i for name, i in record.workers.items() if i in self._registry}
        try:
            workers = self._registry.place(kept, self._load(), record.language)
        except Refusal:
            return False
        if workers["audio"] != record.workers["audio"]:
            record.resume_sequence = record.next_sequence
        record.workers = workers
        record.endpoints = self._registry.endpoints(workers)
        record.delay_ms = self._registry.delay_ms(workers.values())
        record.epoch += 1
        record.moved = True
        record.started_s = now_s
        record.waiting_for = self.participants(record)
        return True

    # --- messages ------------------------------------------------------------------------------

    def start_message(self, record: SessionRecord) -> StartSession:
        """Return what the services of a session are told."""
        return StartSession(
            session=record.name,
            epoch=record.epoch,
            request=record.start_request,
            token=record.token,
            encoding=record.opening.encoding,
            sample_rate_hz=record.opening.sample_rate_hz,
            num_channels=record.opening.num_channels,
            record=record.opening.record,
            paced=record.opening.paced,
            language=record.language,
            endpoints=record.endpoints,
            delay_ms=record.delay_ms,
            lips=record.lips,
            voice=record.opening.voice,
        )

    def opened_message(self, record: SessionRecord, events: str) -> SessionOpened:
        """Return what the client is told."""
        return SessionOpened(
            session=record.name,
            epoch=record.epoch,
            request=record.opening.request,
            token=record.token,
            events=events,
            language=record.language,
            frame_rate_hz=self._registry.frame_rate_hz(record.workers.values()),
            audio=record.endpoints["audio"],
            phones=record.endpoints["phones"],
            faps=record.endpoints["faps"],
        )

    def moved_message(self, record: SessionRecord) -> SessionMoved:
        """Return what the client and all followers are told about a session placed again."""
        return SessionMoved(
            session=record.name,
            epoch=record.epoch,
            next_sequence=record.resume_sequence,
            audio=record.endpoints["audio"],
            phones=record.endpoints["phones"],
            faps=record.endpoints["faps"],
        )

    def state(self, record: SessionRecord, now_s: float) -> SessionState:
        """Return the session's part of a status report."""
        return SessionState(
            session=record.name,
            state="open" if record.announced else "starting",
            age_s=now_s - record.opened_s,
            speaking=record.speaking,
            endpoints=record.endpoints,
            workers=record.workers,
            language=record.language,
        )

    # --- inside --------------------------------------------------------------------------------

    def _load(self) -> Counter[str]:
        return Counter(
            instance for record in self._records.values() for instance in {*record.workers.values()}
        )
