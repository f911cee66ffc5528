"""Sessions as control knows them; no sockets, so that every rule can be tested."""

from __future__ import annotations

import math
import secrets
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from operator import attrgetter

from kouxing.services.control.registry import UNPACED_AUDIO, Refusal, Registry
from kouxing.shared.keys import Peer
from kouxing.shared.wire.control import Heartbeat, StartSession
from kouxing.shared.wire.face import CurrentFace, FaceSettings
from kouxing.shared.wire.session import (
    ErrorCode,
    OpenSession,
    SessionFacts,
    SessionMoved,
    SessionOpened,
    SessionState,
)

KEY_SHARE = 0.75  # of the sessions that one key may have open


@dataclass(slots=True)
class SessionRecord:
    """One session."""

    name: str
    number: int  # grows from session to session
    token: str
    opening: OpenSession
    client: Peer  # on control's socket
    opened_s: float
    started_s: float  # when its services were last told to start it, or one was lost
    workers: dict[str, str]  # instance by endpoint; one that is lost, too
    endpoints: dict[str, str]  # address by endpoint
    facts: SessionFacts  # that its workers state
    face: CurrentFace
    waiting_for: set[str]  # instances that have not started it yet
    held_back: set[str] = field(default_factory=set)  # of them, those to be told after the others
    lost: set[str] = field(default_factory=set)  # of its workers
    epoch: int = 1  # counts its placements
    announced: bool = False  # the client was told that it is open
    moved: bool = False  # placed again, and the client was not told yet
    restored: bool = False  # it was opened at an earlier control
    speaking: bool = False
    speech_time: int = 0  # media time at which that began
    next_sequence: int = 1  # of the first audio message that a new recognizer would need
    resume_sequence: int | None = None  # where a new recognizer starts; None: the old one stays
    media_time: int = 0  # up to where its phones are known to be final

    @property
    def start_request(self) -> str:
        """The request that its services confirm when they have started it."""
        return f"start-{self.name}-{self.epoch}"

    @property
    def audio(self) -> str:
        """Where its client sends audio."""
        live = self.endpoints["audio"]
        return live if self.opening.paced else self.endpoints.get(UNPACED_AUDIO, live)

    @property
    def is_settled(self) -> bool:
        """Whether nothing is due for it before something happens."""
        return self.announced and not (self.moved or self.waiting_for or self.lost)


class Sessions:
    """The open sessions, by name; indexed, so that only few of them are ever walked over."""

    def __init__(self, registry: Registry, max_sessions: int) -> None:
        self._registry = registry
        self._max_sessions = max_sessions
        self._records: dict[str, SessionRecord] = {}
        self._numbers = count()
        self._unsettled: dict[str, SessionRecord] = {}
        self._of_worker: dict[str, dict[str, SessionRecord]] = {}
        self._num_of_key: Counter[str] = Counter()
        self._of_request: dict[tuple[Peer, str], SessionRecord] = {}

    def __iter__(self) -> Iterator[SessionRecord]:
        return iter(list(self._records.values()))

    def __len__(self) -> int:
        return len(self._records)

    def since(self, number: int) -> list[SessionRecord]:
        """Return the sessions from a number on; those that open later have greater ones."""
        records = list(self._records.values())
        return records[bisect_left(records, number, key=attrgetter("number")) :]

    def unsettled(self) -> list[SessionRecord]:
        """Return the sessions that wait for a service, or whose client must be told something."""
        for record in list(self._unsettled.values()):
            if record.is_settled:
                del self._unsettled[record.name]
        return list(self._unsettled.values())

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
        of_key = self._num_of_key[client.key]
        if client.key and of_key >= math.ceil(KEY_SHARE * self._max_sessions):
            raise Refusal(
                ErrorCode.TOO_MANY_SESSIONS,
                f"{of_key} sessions of your key are open already; the rest is for other keys",
            )
        workers = self._registry.place({}, now_s, may_refuse=opening.paced)
        facts = self._registry.facts(workers.values())
        record = SessionRecord(
            name=name,
            number=next(self._numbers),
            token=secrets.token_urlsafe(24),
            opening=opening,
            client=client,
            opened_s=now_s,
            started_s=now_s,
            workers=workers,
            endpoints=self._registry.endpoints(workers),
            facts=facts,
            face=CurrentFace(FaceSettings(lips=facts.lips).updated(opening.face), now_s),
            waiting_for={*workers.values()} | self._registry.observers(),
        )
        self._add(record, now_s)
        return record

    def restore(self, start: StartSession, now_s: float) -> SessionRecord:
        """Take a session over that was placed by an earlier control.

        Its workers are those at its endpoints; where there is none, it is lost.
        """
        found = {name: self._registry.provider(name, at) for name, at in start.endpoints.items()}
        workers = {name: instance or f"lost-{name}" for name, instance in found.items()}
        running = {*found.values()} - {""}
        record = SessionRecord(
            name=start.session,
            number=next(self._numbers),
            token=start.token,
            opening=OpenSession(
                session=start.session,
                request=start.client_request or "",
                encoding=start.encoding,
                sample_rate_hz=start.sample_rate_hz,
                num_channels=start.num_channels,
                record=start.record,
                paced=start.paced,
                mouth_profile=start.mouth_profile,
            ),
            client=Peer(start.client, start.client_key or ""),
            opened_s=now_s,
            started_s=now_s,
            workers=workers,
            endpoints=start.endpoints,
            facts=start.facts,
            face=CurrentFace(start.face, now_s),
            waiting_for=running,
            lost={*workers.values()} - running,
            epoch=start.epoch,
            announced=True,
            restored=True,
            media_time=start.media_time,
        )
        self._add(record, now_s)
        return record

    def remove(self, record: SessionRecord, now_s: float) -> None:
        """Forget a session."""
        del self._records[record.name]
        self._unsettled.pop(record.name, None)
        self._num_of_key[record.client.key] -= 1
        self._of_request.pop((record.client, record.opening.request), None)
        self._set_workers(record, {}, now_s)

    def opened_by(self, opening: OpenSession, client: Peer) -> SessionRecord | None:
        """Return the session that a client opened by this very request, None if none was."""
        record = self._of_request.get((client, opening.request))
        same = record is not None and replace(record.opening, session=opening.session) == opening
        return record if same else None

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
        return ({*record.workers.values()} - record.lost) | self._registry.observers()

    def takes_part(self, record: SessionRecord, instance: str) -> bool:
        """Return whether a service is one of a session's participants."""
        return self._registry.is_observer(instance) or (
            instance in record.workers.values() and instance not in record.lost
        )

    def lose(self, instance: str, now_s: float) -> list[SessionRecord]:
        """Note that a service is lost; return the sessions that miss a worker now."""
        for record in self._unsettled.values():
            record.waiting_for.discard(instance)
        records = list(self._of_worker.get(instance, {}).values())
        for record in records:
            record.lost.add(instance)
            record.started_s = now_s
            self._unsettled[record.name] = record
        return records

    def take_back(self, instance: str) -> list[SessionRecord]:
        """Note that a lost worker was none; return the sessions that it may not have been told."""
        records = [
            record
            for record in self._of_worker.get(instance, {}).values()
            if instance in record.lost
        ]
        for record in records:
            record.lost.remove(instance)
        untold = [record for record in records if record.moved or not record.announced]
        for record in untold:
            record.waiting_for.add(instance)
        return untold

    def take_input(self, record: SessionRecord, heartbeat: Heartbeat) -> float:
        """Note how far a service is with the session's input; return for how long it had none."""
        state = heartbeat.sessions[record.name]
        record.media_time = max(record.media_time, state.media_time)
        if heartbeat.instance != record.workers["audio"]:
            return 0.0
        record.next_sequence = max(record.next_sequence, state.sequence + 1)
        return state.idle_s

    def take_started(self, record: SessionRecord, instance: str, media_time: int) -> set[str]:
        """Note that a service serves a session; return those that can be told now, after it."""
        record.waiting_for.discard(instance)
        record.media_time = max(record.media_time, media_time)
        if record.waiting_for & {*record.workers.values()} > record.held_back:
            return set()
        held_back, record.held_back = record.held_back, set()
        return held_back

    def replace(self, record: SessionRecord, now_s: float) -> bool:
        """Place a session again after workers were lost; return success.

        The recognizer is told after the synthesizer: one that stays knows up to where there are
        phones, and a new one must know the session before it is told what was shown last.
        """
        kept = {name: i for name, i in record.workers.items() if i not in record.lost}
        try:
            workers = self._registry.place(kept, now_s, record.facts.language)
        except Refusal:
            return False
        record.held_back = {workers["audio"]}
        if "audio" not in kept:
            record.resume_sequence = record.next_sequence
        record.lost = set()
        self._set_workers(record, workers, now_s)
        record.endpoints = self._registry.endpoints(workers)
        record.facts = replace(
            self._registry.facts(workers.values()), language=record.facts.language
        )
        record.epoch += 1
        record.moved = True
        record.started_s = now_s
        record.waiting_for = self.participants(record)
        return True

    # --- messages ------------------------------------------------------------------------------

    def start_message(self, record: SessionRecord, now_s: float) -> StartSession:
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
            facts=record.facts,
            endpoints=record.endpoints,
            face=record.face.at(now_s),
            mouth_profile=record.opening.mouth_profile,
            client=record.client.address,
            client_key=record.client.key or None,
            client_request=record.opening.request or None,
            media_time=record.media_time,
            speech_time=record.speech_time if record.speaking else None,
        )

    def opened_message(self, record: SessionRecord, events: str) -> SessionOpened:
        """Return what the client is told."""
        return SessionOpened(
            session=record.name,
            epoch=record.epoch,
            request=record.opening.request,
            token=record.token,
            events=events,
            facts=record.facts,
            audio=record.audio,
            phones=record.endpoints["phones"],
            faps=record.endpoints["faps"],
        )

    def moved_message(self, record: SessionRecord) -> SessionMoved:
        """Return what the client and all followers are told about a session placed again."""
        return SessionMoved(
            session=record.name,
            epoch=record.epoch,
            next_sequence=record.resume_sequence,
            audio=record.audio,
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
            facts=record.facts,
        )

    # --- inside --------------------------------------------------------------------------------

    def _add(self, record: SessionRecord, now_s: float) -> None:
        workers, record.workers = record.workers, {}
        self._records[record.name] = record
        self._unsettled[record.name] = record
        self._num_of_key[record.client.key] += 1
        self._of_request[record.client, record.opening.request] = record
        self._set_workers(record, workers, now_s)

    def _set_workers(self, record: SessionRecord, workers: dict[str, str], now_s: float) -> None:
        before, after = {*record.workers.values()}, {*workers.values()}
        for instance in before - after:
            of_worker = self._of_worker[instance]
            del of_worker[record.name]
            self._registry.load(instance).leave(now_s, paced=record.opening.paced)
            if not of_worker:
                del self._of_worker[instance]
                self._registry.forget_load(instance)
        record.workers = workers
        for instance in after - before:
            self._of_worker.setdefault(instance, {})[record.name] = record
            self._registry.load(instance).place(now_s, paced=record.opening.paced)
