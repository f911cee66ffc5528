"""Starts, announces, moves and ends sessions.

Each step is sent to the services and the client of the session, and is published as an event.
"""

import math
import time

from kouxing_client.field_types import MAX_TEXT
from kouxing_client.messages import Event, Message

from kouxing.services.control.request_handler import RequestHandler
from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.services.control.session_record import SessionRecord
from kouxing.services.control.session_table import SessionTable
from kouxing.shared.fast_record import replace
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.network.sockets import Socket
from kouxing.shared.wire.control import EventName
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import CloseSession, Error, ErrorCode, SessionMoved

START_TIMEOUT_S = 5.0  # how long a new session waits for its workers, or a driver that records it
OBSERVER_TIMEOUT_S = 0.5  # how long a new session waits for other observers
MOVE_TIMEOUT_S = 20.0  # time without a worker after which a session is closed
REPEAT_AFTER_S = (1.0, 2.0, 4.0, 8.0)  # delays of repeated messages: a connection may have broken


class SessionLifecycle:
    """Manages the lifecycle of control's sessions.

    ``commands`` is the socket for services and clients. ``events`` is the publisher of events, and
    ``events_address`` the publisher's address for clients.
    """

    def __init__(
        self,
        registry: ServiceRegistry,
        sessions: SessionTable,
        requests: RequestHandler,
        commands: Socket,
        events: Socket,
        events_address: str,
        metrics: Metrics,
    ) -> None:
        self._registry = registry
        self._sessions = sessions
        self._requests = requests
        self._commands = commands
        self._events = events
        self._events_address = events_address
        self._metrics = metrics
        self._num_events = 0
        self._repeats: list[tuple[float, SessionMoved]] = []  # times and messages to repeat

    def on_tick(self, now_s: float) -> float:
        """Repeat move messages and check timeouts; return when the next repetition is due."""
        due = [moved for due_s, moved in self._repeats if due_s <= now_s]
        if due:
            self._repeats = [repeat for repeat in self._repeats if repeat[0] > now_s]
        for moved in due:
            record = self._sessions.get(moved.session)
            if record is not None and record.epoch == moved.epoch:
                self._commands.send(moved, to=record.client)
        for record in self._sessions.pending():
            self._check_timeout(record, now_s)
        return min((due_s for due_s, _ in self._repeats), default=math.inf)

    def send_start(self, record: SessionRecord, instances: set[str]) -> None:
        """Send services the start of a session."""
        start = record.start_message(time.monotonic())
        for instance in instances:
            self._commands.send(start, to=self._registry[instance].peer)

    def send_to_participants(self, record: SessionRecord, message: Message) -> None:
        """Send a message to the services of a session."""
        for instance in self._sessions.participants(record):
            self._commands.send(message, to=self._registry[instance].peer)

    def change_face(self, record: SessionRecord, change: FaceSettings) -> None:
        """Change a session's face, and notify its services."""
        self._sessions.change_face(record, change, time.monotonic())
        self.send_to_participants(
            record, SetFace(session=record.name, epoch=record.epoch, face=change)
        )

    def set_speaking(self, record: SessionRecord, *, speaking: bool) -> None:
        """Record whether a session has speech, and notify the faces of its listeners."""
        record.is_speaking = speaking
        for listener in self._sessions.listeners_of(record.name):
            self.change_face(listener, FaceSettings(listening=speaking))

    def announce_if_started(self, record: SessionRecord) -> None:
        """Notify the client that its session is open or has moved, once all services are ready.

        A new session waits for the observers, so that they miss no message. A moved session does
        not wait for them, because its client still has audio to resend.
        """
        if record.lost:
            return
        if not record.is_announced and not record.waiting_for:
            record.is_announced, record.has_unannounced_move = True, False
            self.publish(EventName.SESSION_OPENED, record)
            opened = record.opened_message(self._events_address)
            self._requests.answer(record.client, record.opening.request, opened)
        elif record.has_unannounced_move and record.is_announced and not record.missing_workers:
            self._announce_move(record)

    def move(self, record: SessionRecord) -> None:
        """Move a session to other workers if any are free."""
        if self._sessions.move(record, time.monotonic()):
            self.send_start(record, record.waiting_for - record.deferred)

    def move_from(self, record: SessionRecord, instance: str, error: Error) -> None:
        """Move a session away from a worker that rejected it; end it if no other is free."""
        record.rejected_by.add(instance)
        record.lost.add(instance)
        self.move(record)
        if record.lost:
            self.end(record, f"{instance} cannot serve the session: {error.text}")

    def reject(self, record: SessionRecord, error: Error) -> None:
        """Reject a session that is not announced to its client yet, and end it."""
        request = record.opening.request
        self._requests.answer(record.client, request, replace(error, request=request))
        self.end(record, error.text)

    def end(self, record: SessionRecord, reason: str) -> None:
        """End a session; ``reason`` is for the log and the event."""
        if record.is_speaking:
            self.set_speaking(record, speaking=False)
        close = CloseSession(session=record.name, epoch=record.epoch)
        self.send_to_participants(record, close)
        self._sessions.remove(record, time.monotonic())
        self.publish(EventName.SESSION_CLOSED, record, detail=reason)
        LOG.info("session closed: %s", reason, extra={"session": record.name})

    def end_revoked(self) -> None:
        """End the sessions of keys that were revoked or can no longer open sessions."""
        has_role = self._requests.has_role
        revoked = {key for key in self._sessions.client_keys() if not has_role(key, "client")}
        for record in self._sessions if revoked else ():
            if record.client.key in revoked:
                self.end(record, "its client's key was revoked")

    def publish(
        self,
        name: EventName,
        record: SessionRecord | None = None,
        *,
        detail: str = "",
        media_time: int = 0,
    ) -> None:
        """Publish an event, which may be about a session."""
        self.publish_event(
            Event(
                session="" if record is None else record.name,
                session_id=None if record is None else record.session_id,
                media_time=media_time,
                name=name,
                detail=detail[:MAX_TEXT],
            )
        )

    def publish_event(self, event: Event) -> None:
        """Publish an event with the next number."""
        self._num_events += 1
        self._metrics.count(f"event_{event.name}")
        self._events.send(replace(event, sequence=self._num_events))

    def _check_timeout(self, record: SessionRecord, now_s: float) -> None:
        waited_s = now_s - record.started_s
        if record.lost:
            if waited_s > MOVE_TIMEOUT_S:
                lost = ", ".join(sorted(record.lost))
                self.end(record, f"{lost} is lost, and no other worker is free")
        elif record.waiting_for and waited_s > _limit_s(record):
            self._stop_waiting(record)
        else:
            self.announce_if_started(record)

    def _announce_move(self, record: SessionRecord) -> None:
        moved = record.moved_message()
        record.has_unannounced_move, record.resume_sequence = False, None
        record.rejected_by.clear()
        self._commands.send(moved, to=record.client)
        self._events.send(moved)
        self.publish(EventName.SESSION_MOVED, record)
        workers = ", ".join(sorted({*record.workers.values()}))
        LOG.info("session moved to %s", workers, extra={"session": record.name})
        now_s = time.monotonic()
        self._repeats += [(now_s + after_s, moved) for after_s in REPEAT_AFTER_S]

    def _stop_waiting(self, record: SessionRecord) -> None:
        """Continue without the missing observers. If a worker is missing, end the session."""
        missing = record.missing_workers
        if not missing:
            record.waiting_for.clear()
            self.announce_if_started(record)
            return
        text = f"{', '.join(sorted(missing))} did not start the session in time"
        if record.is_announced:
            self.end(record, text)
        else:
            error = Error(session=record.name, code=ErrorCode.TIMEOUT, text=text)
            self.reject(record, error)


def _limit_s(record: SessionRecord) -> float:
    """Return how long to wait for the services that have not started a session."""
    if record.is_announced:
        return MOVE_TIMEOUT_S
    if record.missing_workers or record.opening.record:  # a driver may reject the recording
        return START_TIMEOUT_S
    return OBSERVER_TIMEOUT_S
