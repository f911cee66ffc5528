"""Keeps the open sessions, without sockets, so that tests can check every rule."""

import math
import secrets
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from itertools import count
from operator import attrgetter

from kouxing.services.control.face_check import check_acoustic_model
from kouxing.services.control.placement import Placement
from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.services.control.session_record import SessionRecord
from kouxing.shared.errors import Rejected, UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.phones.inventory import find_language
from kouxing.shared.settings.keys import MAX_KEY_SHARE
from kouxing.shared.wire.control import Heartbeat, StartSession
from kouxing.shared.wire.face import CurrentFace, FaceSettings
from kouxing.shared.wire.session import ErrorCode, OpenSession


class SessionTable:
    """The open sessions, by name. Indexes avoid iterating over all sessions."""

    def __init__(self, registry: ServiceRegistry, placement: Placement, max_sessions: int) -> None:
        self._registry = registry
        self._placement = placement
        self._max_sessions = max_sessions
        self._records: dict[str, SessionRecord] = {}
        self._numbers = count()
        self._pending: dict[str, SessionRecord] = {}
        self._by_worker: dict[str, dict[str, SessionRecord]] = {}
        self._num_per_key: Counter[str] = Counter()
        self._by_request: dict[tuple[Peer, str], SessionRecord] = {}
        self._listeners: dict[str, set[str]] = {}  # by the session to which their faces listen

    def __iter__(self) -> Iterator[SessionRecord]:
        return iter(list(self._records.values()))

    def __len__(self) -> int:
        return len(self._records)

    # --- lookups -------------------------------------------------------------------------------

    def get(self, name: str) -> SessionRecord | None:
        """Return a session, or None."""
        return self._records.get(name)

    def find(self, name: str) -> SessionRecord:
        """Return a session; raise ``Rejected`` if there is no such session."""
        record = self._records.get(name)
        if record is None:
            text = f"session {name!r} does not exist; open it first"
            raise Rejected(ErrorCode.UNKNOWN_SESSION, text)
        return record

    def listeners_of(self, name: str) -> list[SessionRecord]:
        """Return the sessions whose faces listen to a session."""
        return [self._records[listener] for listener in self._listeners.get(name, ())]

    def with_listening(self, face: FaceSettings) -> FaceSettings:
        """Add ``listening`` to settings that choose the session to which a face listens."""
        if face.listen_to is None or face.listening is not None:
            return face
        speaker = self._records.get(face.listen_to)
        return replace(face, listening=speaker is not None and speaker.is_speaking)

    def find_authorized(self, name: str, token: str) -> SessionRecord:
        """Return a session after checking its token.

        Raises ``Rejected`` if there is no such session, or it has another token.
        """
        record = self.find(name)
        if not secrets.compare_digest(record.token.encode(), token.encode()):
            raise Rejected(
                ErrorCode.BAD_TOKEN,
                f"wrong token for session {name!r}; use the token from session-opened",
            )
        return record

    def find_by_request(self, opening: OpenSession, client: Peer) -> SessionRecord | None:
        """Return the session that a client opened with this request, or None."""
        record = self._by_request.get((client, opening.request))
        if record is None:
            return None
        is_same = replace(record.opening, session=opening.session, face=opening.face) == opening
        return record if is_same else None

    def sessions_from(self, number: int) -> list[SessionRecord]:
        """Return the sessions with this number or more. Newer sessions have greater numbers."""
        records = list(self._records.values())
        return records[bisect_left(records, number, key=attrgetter("number")) :]

    def client_keys(self) -> list[str]:
        """Return the public keys of the clients that have sessions."""
        return [key for key, number in self._num_per_key.items() if number]

    def pending(self) -> list[SessionRecord]:
        """Return the sessions that wait for a service, or whose client must be notified."""
        for record in list(self._pending.values()):
            if record.is_up_to_date:
                del self._pending[record.name]
        return list(self._pending.values())

    def num_speaking(self, instance: str) -> int:
        """Return the number of a worker's sessions with current speech."""
        return sum(record.is_speaking for record in self._by_worker.get(instance, {}).values())

    def participants(self, record: SessionRecord) -> set[str]:
        """Return a session's running services: its workers and all observers."""
        return ({*record.workers.values()} - record.lost) | self._registry.observers()

    def is_participant(self, record: SessionRecord, instance: str) -> bool:
        """Return whether a service takes part in a session."""
        return self._registry.is_observer(instance) or (
            instance in record.workers.values() and instance not in record.lost
        )

    # --- sessions start and end ----------------------------------------------------------------

    def open(self, opening: OpenSession, client: Peer, now_s: float) -> SessionRecord:
        """Place a new session.

        Raises ``Rejected`` if the name is taken, there are too many sessions, a service is
        missing or busy, or no recognizer or acoustic model has the language.
        """
        name = opening.session or f"s{secrets.token_hex(4)}"
        if name in self._records:
            text = f"session {name!r} is open; choose another name"
            raise Rejected(ErrorCode.SESSION_EXISTS, text)
        if len(self._records) >= self._max_sessions:
            text = f"the limit of control.max_sessions is reached: {self._max_sessions}"
            raise Rejected(ErrorCode.TOO_MANY_SESSIONS, text)
        num_of_key = self._num_per_key[client.key]
        if client.key and num_of_key >= math.ceil(MAX_KEY_SHARE * self._max_sessions):
            text = f"your key has {num_of_key} open sessions, the maximum; close one first"
            raise Rejected(ErrorCode.TOO_MANY_SESSIONS, text)
        if opening.record and not self._registry.has_driver():
            text = (
                "no driver is running to write the video; start one with 'kouxing driver', or open"
                " the session without 'record'"
            )
            raise Rejected(ErrorCode.NO_SERVICE, text)
        leaves_room = client.key and num_of_key and not opening.paced  # room for another client
        language = _language_of(opening)
        workers = self._placement.place({}, now_s, language, min_room=2 if leaves_room else 1)
        facts = self._registry.facts(workers.values())
        if language is not None:
            facts = replace(facts, language=language)
        check_acoustic_model(opening.face, facts.language)
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
            face=CurrentFace(
                FaceSettings(lip_model=facts.lip_model).merged_with(
                    self.with_listening(opening.face)
                ),
                now_s,
            ),
            waiting_for={*workers.values()} | self._registry.observers(),
        )
        self._add(record, now_s)
        return record

    def restore(self, start: StartSession, now_s: float) -> SessionRecord:
        """Add a session that an earlier control placed. Workers that do not run count as lost."""
        running: set[str] = set()
        workers: dict[str, str] = {}
        for name, address in start.endpoints.items():
            instance = self._registry.worker_at(name, address)
            workers[name] = instance or f"lost-{name}"
            if instance is not None:
                running.add(instance)
        record = SessionRecord(
            name=start.session,
            number=next(self._numbers),
            token=start.token,
            opening=start.opening,
            client=Peer(start.client, start.client_key or ""),
            opened_s=now_s,
            started_s=now_s,
            workers=workers,
            endpoints=start.endpoints,
            facts=start.facts,
            face=CurrentFace(start.opening.face, now_s),
            waiting_for=running,
            lost={*workers.values()} - running,
            epoch=start.epoch,
            recognizer_epoch=start.epoch,
            is_announced=True,
            restored_epoch=start.epoch,
            final_until=start.final_until,
            is_speaking=start.speech_time is not None,
            speech_time=start.speech_time or 0,
        )
        self._add(record, now_s)
        return record

    def remove(self, record: SessionRecord, now_s: float) -> None:
        """Remove a session."""
        del self._records[record.name]
        self._pending.pop(record.name, None)
        self._num_per_key[record.client.key] -= 1
        self._by_request.pop((record.client, record.opening.request), None)
        self._remove_listener(record)
        self._set_workers(record, {}, now_s)

    def change_face(self, record: SessionRecord, change: FaceSettings, now_s: float) -> None:
        """Change the settings of a session's face."""
        self._remove_listener(record)
        record.face.change(change, now_s)
        self._add_listener(record)

    # --- reports of services -------------------------------------------------------------------

    def record_progress(self, record: SessionRecord, heartbeat: Heartbeat) -> float:
        """Record a service's progress in a session; return the time without input."""
        if not record.is_announced:  # the heartbeat may be about an earlier session with this name
            return 0.0
        state = heartbeat.sessions[record.name]
        record.final_until = max(record.final_until, state.final_until)
        if state.skipped_s:
            record.skipped_s[heartbeat.instance] = state.skipped_s
        if heartbeat.instance == record.workers["faps"]:
            record.lateness = state.lateness
        if heartbeat.instance != record.workers["audio"]:
            return 0.0
        record.next_sequence = max(record.next_sequence, state.last_droppable_sequence + 1)
        return state.idle_s

    def record_started(self, record: SessionRecord, instance: str, final_until: int) -> set[str]:
        """Record that a service serves a session; return deferred services to notify now."""
        record.waiting_for.discard(instance)
        record.started.add(instance)
        record.final_until = max(record.final_until, final_until)
        if record.missing_workers > record.deferred:
            return set()
        deferred, record.deferred = record.deferred, set()
        return deferred

    def mark_worker_lost(self, instance: str, now_s: float) -> list[SessionRecord]:
        """Record that a service is lost; return the sessions that now lack a worker."""
        for record in self._pending.values():
            record.waiting_for.discard(instance)
            record.deferred.discard(instance)
        records = list(self._by_worker.get(instance, {}).values())
        for record in records:
            record.lost.add(instance)
            record.started_s = now_s
            self._pending[record.name] = record
        return records

    def reinstate_worker(self, instance: str) -> list[SessionRecord]:
        """Reinstate a worker that was declared lost by mistake.

        Returns the sessions whose start it may have missed.
        """
        records = [
            record
            for record in self._by_worker.get(instance, {}).values()
            if instance in record.lost
        ]
        for record in records:
            record.lost.remove(instance)
        missed_start = [
            record for record in records if record.has_unannounced_move or not record.is_announced
        ]
        for record in missed_start:
            record.waiting_for.add(instance)
        return missed_start

    def move(self, record: SessionRecord, now_s: float) -> bool:
        """Place a session again after it lost workers; return whether that succeeded.

        Workers that rejected this move are not chosen.

        The recognizer is notified last. By then the synthesizer has reported its final phones, or a
        new synthesizer has the session, so the recognizer can resume the face there.
        """
        remaining = {
            endpoint: instance
            for endpoint, instance in record.workers.items()
            if instance not in record.lost
        }
        try:
            workers = self._placement.place(
                remaining, now_s, record.facts.language, excluded=record.rejected_by
            )
        except Rejected:
            return False
        record.deferred = {workers["audio"]}
        record.epoch += 1
        if "audio" not in remaining:
            record.resume_sequence = record.next_sequence
            record.recognizer_epoch = record.epoch
        record.lost = set()
        self._set_workers(record, workers, now_s)
        record.endpoints = self._registry.endpoints(workers)
        facts = self._registry.facts(workers.values())
        record.facts = replace(facts, language=record.facts.language)
        record.has_unannounced_move = True
        record.started_s = now_s
        record.waiting_for = self.participants(record)
        record.started = set()
        return True

    def _add(self, record: SessionRecord, now_s: float) -> None:
        workers, record.workers = record.workers, {}
        self._records[record.name] = record
        self._pending[record.name] = record
        self._num_per_key[record.client.key] += 1
        self._by_request[record.client, record.opening.request] = record
        self._add_listener(record)
        self._set_workers(record, workers, now_s)

    def _add_listener(self, record: SessionRecord) -> None:
        if speaker := record.face.settings.listen_to:
            self._listeners.setdefault(speaker, set()).add(record.name)

    def _remove_listener(self, record: SessionRecord) -> None:
        if speaker := record.face.settings.listen_to:
            self._listeners[speaker].remove(record.name)
            if not self._listeners[speaker]:
                del self._listeners[speaker]

    def _set_workers(self, record: SessionRecord, workers: dict[str, str], now_s: float) -> None:
        before, after = {*record.workers.values()}, {*workers.values()}
        for instance in before - after:
            sessions_of_worker = self._by_worker[instance]
            del sessions_of_worker[record.name]
            self._registry.load(instance).remove_session(now_s, paced=record.opening.paced)
            if not sessions_of_worker:
                del self._by_worker[instance]
                self._registry.forget_load(instance)
        record.workers = workers
        for instance in after - before:
            self._by_worker.setdefault(instance, {})[record.name] = record
            self._registry.load(instance).add_session(now_s, paced=record.opening.paced)


def _language_of(opening: OpenSession) -> str | None:
    """Return the name of the language that a client requested; None without a request."""
    if opening.language is None:
        return None
    try:
        return find_language(opening.language)
    except UserError as error:
        raise Rejected(ErrorCode.BAD_LANGUAGE, str(error)) from None
