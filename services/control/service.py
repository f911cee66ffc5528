"""Control: opens sessions, places them on workers, and publishes events.

Li et al. 2011, section 2: the control module initializes the others, passes messages between them
and synchronizes them. Audio, phones and FAPs do not pass through it.

After a restart, control restores the sessions from the reports of the services.
"""

import secrets
import time
from collections.abc import Callable
from typing import Any

from kouxing_client.messages import Event, Message, Speech

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.face_check import check_acoustic_model, check_face
from kouxing.services.control.fault_log import FaultLog
from kouxing.services.control.key_distributor import KeyDistributor
from kouxing.services.control.placement import Placement
from kouxing.services.control.request_handler import RequestHandler
from kouxing.services.control.restart_recovery import RestartRecovery
from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.services.control.session_lifecycle import SessionLifecycle
from kouxing.services.control.session_record import SessionRecord
from kouxing.services.control.session_table import SessionTable
from kouxing.services.control.status_reporter import StatusReporter
from kouxing.services.service_kinds import KINDS
from kouxing.shared.clock import StallDetector, now_ns
from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.network.bus import COMMAND_LIMITS
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.service.base import Service
from kouxing.shared.service.message_loop import Handler
from kouxing.shared.settings.endpoints import with_key
from kouxing.shared.wire.control import EventName, Heartbeat, HeartbeatReply, SessionStarted
from kouxing.shared.wire.face import CurrentFace, FaceSettings, SetFace
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    FlushSession,
    OpenSession,
    StatusRequest,
)

STOPPED = "stopped"  # reason for a service that shut down
CHECK_S = 0.5  # interval of checking waiting sessions and the list of keys
MAX_TICK_DELAY_S = 0.1  # if a tick is later than this, control itself was stalled
# events that a service may publish
SERVICE_EVENTS = (
    EventName.AUDIO_SKIPPED,
    EventName.ERROR,
    EventName.LAUGHTER_START,
    EventName.LAUGHTER_STOP,
    EventName.RECORDED,
)


class ControlService(Service):
    """The control process."""

    kind = KINDS["control"]
    connects_to_control = False

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config, extra_connections=config.max_sessions)
        now_s = time.monotonic()
        self._registry = ServiceRegistry(config.lost_after_s)
        self._placement = Placement(self._registry, config.max_load)
        self._sessions = SessionTable(self._registry, self._placement, config.max_sessions)
        self._status = StatusReporter(self._registry, self._sessions)
        self._process_id = secrets.token_hex(8)  # not the instance name, which may be a setting
        self._faults = FaultLog()
        self._resting_face = CurrentFace(FaceSettings(), now_s)
        self._recovery = RestartRecovery(self._registry, now_s)
        self._idle_limit_s = config.idle_limit_s
        self._keys = KeyDistributor(self.bus.zap)
        self._keys_version = (0, 0)  # version of the key list for which revoked sessions have ended
        self._tick_stall = StallDetector(now_s, MAX_TICK_DELAY_S)
        self._sleep_s = 0.0  # planned time until the next tick
        self._commands = self.bus.bind_router(
            config.bound_control, "control.control", COMMAND_LIMITS
        )
        self._events = self.bus.bind_publisher(config.events, "control.events")
        public = self.key.public if self.key else ""
        self.endpoints = {
            name: with_key(config.advertised_endpoint(socket.endpoint), public)
            for name, socket in (("commands", self._commands), ("events", self._events))
        }
        requests = self._requests = RequestHandler(
            self.bus, self._commands, self.metrics, may_defer=lambda: self._recovery.is_active
        )
        self._lifecycle = SessionLifecycle(
            self._registry,
            self._sessions,
            requests,
            commands=self._commands,
            events=self._events,
            events_address=self.endpoints["events"],
            metrics=self.metrics,
        )
        self.register(
            self._commands,
            {
                OpenSession: requests.make_handler(self._open_session, "client"),
                CloseSession: requests.make_handler(self._close_session, "client"),
                FlushSession: requests.make_handler(self._flush_session, "client"),
                SetFace: requests.make_handler(self._set_face, "client", "operator"),
                StatusRequest: requests.make_handler(self._report_status),
                Heartbeat: self._on_heartbeat,
                SessionStarted: self._service_handler(self._on_session_started),
                Error: self._service_handler(self._on_start_rejected),
                Speech: self._service_handler(self._on_speech),
                Event: self._service_handler(self._on_service_event),
            },
        )
        self.register(self._events, {})

    def deliver_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Register control like any other service."""
        self._registry.add(heartbeat, NO_PEER, time.monotonic())

    def gauges(self) -> dict[str, float]:
        """Return the number of sessions and services."""
        return {"sessions": len(self._sessions), "services": len(self._registry)}

    def on_tick(self, now_s: float) -> float:
        """Check for lost services, sessions that wait too long, and changed keys."""
        pause_s = self._tick_stall.check(now_s, expected_s=self._sleep_s)
        self._registry.exclude_pause(pause_s - MAX_TICK_DELAY_S, now_s)
        if self.bus.zap is not None:
            self.bus.zap.refresh()
            if self.bus.zap.version != self._keys_version:
                self._keys_version = self.bus.zap.version
                self._lifecycle.end_revoked()
        if self._recovery.is_active and now_s > self._recovery.end_s:
            self._recovery.is_active = False
            self._restore_sessions()
        for connection in self._commands.ended():
            if instance := self._registry.instance_by_connection(connection):
                has_stopped = self._registry[instance].state == "draining"
                reason = STOPPED if has_stopped else "its connection closed"
                self._remove_service(instance, reason)
        for instance in self._registry.overdue_services(now_s):
            self._remove_service(instance, "no heartbeat")
        self._faults.warn(now_s)
        moves_due_s = self._lifecycle.on_tick(now_s)
        due_s = min(now_s + CHECK_S, self._registry.next_overdue_s(), moves_due_s)
        self._sleep_s = max(0.0, due_s - now_s)
        return due_s

    def on_drain(self) -> bool:
        """Close all sessions."""
        for record in self._sessions:
            self._lifecycle.end(record, "control stops")
        return True

    # --- requests of clients ---

    def _open_session(self, message: OpenSession, sender: Peer) -> Message | None:
        known = self._sessions.find_by_request(message, sender)
        if known is not None and known.restored_epoch:
            return known.opened_message(self.endpoints["events"])
        if known is not None and not self._commands.is_open(known.client.connection):
            known.client = sender  # the client has reconnected
            if known.is_announced and known.next_sequence == 1:
                # the client may not have received its token
                self._lifecycle.end(known, "its client was disconnected before the answer arrived")
                known = None
        if known is not None and not known.is_announced:
            return None  # the services are starting
        check_face(message.face, self._registry.lip_models(), message.session)
        record = self._sessions.open(message, sender, time.monotonic())
        LOG.info("session opened", extra={"session": record.name})
        self._lifecycle.send_start(record, record.waiting_for)
        return None

    def _close_session(self, message: CloseSession, _sender: Peer) -> Message | None:
        record = self._sessions.find_authorized(message.session, message.token or "")
        self._lifecycle.end(record, "closed by its client")
        return _done(message)

    def _flush_session(self, message: FlushSession, _sender: Peer) -> Message | None:
        record = self._sessions.find_authorized(message.session, message.token)
        self._lifecycle.send_to_participants(record, replace(message, epoch=record.epoch))
        self._lifecycle.publish(EventName.SESSION_FLUSHED, record)
        return _done(message)

    def _set_face(self, message: SetFace, _sender: Peer) -> Message | None:
        check_face(message.face, self._registry.lip_models(), message.session)
        if message.session == "":  # the face at rest, which only observers show
            self._resting_face.change(message.face, time.monotonic())
            for instance in self._registry.observers():
                peer = self._registry[instance].peer
                self._commands.send(replace(message, request=None), to=peer)
        else:
            record = self._sessions.find(message.session)
            check_acoustic_model(message.face, record.facts.language)
            self._lifecycle.change_face(record, self._sessions.with_listening(message.face))
        return _done(message)

    def _report_status(self, message: StatusRequest, sender: Peer) -> Message:
        now_s = time.monotonic()
        return self._status.report(
            message,
            now_s,
            resting_face=self._resting_face.at(now_s),
            shows_token=self._requests.may_see_token(sender),
        )

    # --- messages of services ---

    def _service_handler(self, handle: Callable[[Any, str], None]) -> Handler:
        """Return a handler that passes messages of registered services on, with their instance."""

        def on_message(message: Message, sender: Peer) -> None:
            instance = self._registry.instance_by_peer(sender)
            if instance is not None:
                handle(message, instance)
            else:
                text = f"dropped a {message.kind} message: the sender is not a service"
                self.warn("no-service", text, message.session)

        return on_message

    def _on_heartbeat(self, heartbeat: Heartbeat, sender: Peer) -> None:
        received_ns = now_ns()
        instance = heartbeat.instance
        try:
            self._requests.check_role(sender, f"service:{heartbeat.service}")
            self._registry.check(heartbeat, sender)
            is_other = self._registry.is_other_process(heartbeat, sender)
        except Rejected as rejection:
            self.warn(rejection.code, f"{instance}: {rejection.text}")
            self._commands.send(Error(code=rejection.code, text=rejection.text), to=sender)
            return
        if is_other:
            self._remove_service(instance, "it restarted")
        is_new = instance not in self._registry
        is_gone = heartbeat.state == "draining" or self._registry.is_stale(instance, sender)
        if is_new and is_gone:
            self._check_sessions(heartbeat, sender)  # sessions that have moved
            return
        replaced = self._registry.find_replaced_worker(heartbeat, sender) if is_new else None
        num_speaking = self._sessions.num_speaking(instance)
        self._registry.add(heartbeat, sender, time.monotonic(), num_speaking)
        self._recovery.record_observer(heartbeat)
        self._check_sessions(heartbeat, sender)  # before other sessions are placed on this worker
        if is_new:
            was_lost = self._registry.reclaim_lost(instance, sender) and not is_other
            self._on_new_service(heartbeat, sender, replaced, was_lost=was_lost)
        # The reply is sent last, so that a stalled service first learns which sessions have moved.
        reply = HeartbeatReply(
            sent_ns=heartbeat.sent_ns,
            received_ns=received_ns,
            replied_ns=now_ns(),
            control_instance=self._process_id,
            keys=self._keys.next_key_update(heartbeat),
            missing=self._placement.missing_kinds(),
            idle_limit_s=self._idle_limit_s,
        )
        self._commands.send(reply, to=sender)
        if heartbeat.state == "draining" and heartbeat.role == "worker":
            self._move_sessions_of(instance)  # the worker serves its sessions until they have moved
        elif heartbeat.state == "draining":
            self._remove_service(instance, STOPPED)

    def _on_new_service(
        self, heartbeat: Heartbeat, sender: Peer, replaced: str | None, *, was_lost: bool
    ) -> None:
        """Assign sessions that lack a worker to a new worker, or all sessions to a new observer.

        A worker that was declared lost by mistake keeps the sessions that have not moved.
        """
        now_s = time.monotonic()
        lasted_s = self._faults.end(heartbeat.instance, now_s)
        self._lifecycle.publish(
            EventName.SERVICE_READY, detail=f"{heartbeat.service} {heartbeat.instance}"
        )
        if replaced is not None:
            self._remove_service(replaced, f"{heartbeat.instance} took its place")
        missed_start = []
        if was_lost:
            self._registry.adapt_timeout(lasted_s, now_s)
            missed_start = self._sessions.reinstate_worker(heartbeat.instance)
        self._restore_sessions()
        for record in self._sessions.pending():
            if record.lost:
                self._lifecycle.move(record)
        if heartbeat.role == "observer":
            missed_start = [
                record for record in self._sessions if not _has_started(record, heartbeat)
            ]
        for record in missed_start:
            self._commands.send(record.start_message(time.monotonic()), to=sender)

    def _check_sessions(self, heartbeat: Heartbeat, sender: Peer) -> None:
        """Stop sessions that a service must not serve, and end sessions without input."""
        for name in heartbeat.sessions:
            record = self._sessions.get(name)
            if record is None and self._recovery.is_active:
                continue
            if record is not None and heartbeat.instance in record.lost:
                continue  # the session has not moved yet
            if record is not None and record.has_unannounced_move and heartbeat.state == "draining":
                continue  # the new worker is starting
            if record is None or not self._sessions.is_participant(record, heartbeat.instance):
                self._commands.send(CloseSession(session=name), to=sender)
            elif self._sessions.record_progress(record, heartbeat) > self._idle_limit_s:
                self._lifecycle.end(record, f"no audio for {self._idle_limit_s:g} s")

    def _on_session_started(self, started: SessionStarted, instance: str) -> None:
        record = self._sessions.get(started.session)
        if started.start is not None and record is None:
            if self._recovery.add_reported_session(started.start, instance):
                self._restore_sessions()
            else:
                text = f"{instance} may not report this session"
                self.warn("no-takeover", text, started.session)
        elif record is not None and started.request == record.start_request:
            deferred = self._sessions.record_started(record, instance, started.final_until)
            self._lifecycle.send_start(record, deferred)
            self._lifecycle.announce_if_started(record)

    def _on_start_rejected(self, error: Error, instance: str) -> None:
        """Reject a session that a service rejected, or move it to another worker."""
        record = self._sessions.get(error.session)
        if record is None or error.request != record.start_request:
            return
        if instance not in record.waiting_for:
            return
        if not record.is_announced:
            self._lifecycle.reject(record, error)
        elif instance in record.workers.values():
            self._lifecycle.move_from(record, instance, error)

    def _on_speech(self, speech: Speech, instance: str) -> None:
        record = self._sessions.get(speech.session)
        if record is None:
            self._recovery.record_speech(speech, instance)
            return
        if not record.is_announced:  # it is about an earlier session with this name
            return
        if instance != record.workers["audio"] or speech.epoch < record.recognizer_epoch:
            return
        if not record.is_speaking:  # a new recognizer repeats the start of speech
            record.speech_time = speech.media_time
        name = EventName.SPEECH_START if speech.active else EventName.SPEECH_STOP
        self._lifecycle.publish(name, record, media_time=speech.media_time)
        self._lifecycle.set_speaking(record, speaking=speech.active)

    def _on_service_event(self, event: Event, instance: str) -> None:
        if event.name in SERVICE_EVENTS:
            self._lifecycle.publish_event(event)
        else:
            self.warn("event", f"{instance} may not publish {event.name!r}", event.session)

    def _remove_service(self, instance: str, reason: str) -> None:
        """Remove a service that stopped, restarted or is lost, and move its sessions."""
        self._registry.remove(instance)
        self._keys.forget(instance)
        if reason == STOPPED:
            LOG.info("%s stopped", instance)
        else:
            self._faults.begin(instance, reason, time.monotonic())
        self._lifecycle.publish(EventName.SERVICE_LOST, detail=f"{instance}: {reason}")
        self._move_sessions_of(instance)

    def _move_sessions_of(self, instance: str) -> None:
        for record in self._sessions.mark_worker_lost(instance, time.monotonic()):
            self._lifecycle.move(record)

    # --- sessions ---

    def _restore_sessions(self) -> None:
        """Restore sessions whose workers are all back; at the deadline, restore the rest."""
        for start in self._recovery.pop_complete():
            if self._sessions.get(start.session) is not None:
                continue
            record = self._sessions.restore(start, time.monotonic())
            LOG.info("session restored", extra={"session": record.name})
            self._lifecycle.set_speaking(record, speaking=record.is_speaking)
            if record.face.settings.listen_to:  # that session may have changed in the meantime
                listen_to = FaceSettings(listen_to=record.face.settings.listen_to)
                self._lifecycle.change_face(record, self._sessions.with_listening(listen_to))
            missed_start = self._recovery.observers_that_missed_start(record.name)
            self._lifecycle.send_start(record, record.waiting_for | missed_start)
            if record.lost:
                self._lifecycle.move(record)
        self._lifecycle.end_revoked()
        self._requests.retry_deferred()


def _has_started(record: SessionRecord, observer: Heartbeat) -> bool:
    """Return whether an observer takes part in the current epoch of a session.

    It may have missed a move, or have another session with this name, whose end it missed.
    """
    is_current = record.epoch == record.restored_epoch or observer.instance in record.started
    return is_current and record.name in observer.sessions


def _done(message: CloseSession | FlushSession | SetFace) -> Done | None:
    """Return the answer to a completed request; None if no answer is needed."""
    if message.request is None:
        return None
    return Done(session=message.session, request=message.request)
