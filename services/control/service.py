"""Control: opens sessions, hands out endpoints, passes speech events on, knows who is alive.

Li et al. 2011, section 2: the control module initialises the others, passes messages between them
and keeps them in step. Audio, phones and FAPs never pass through it.

A control that starts again asks nobody: services tell it the sessions that they serve.

Reacts to: open-session, close-session, flush-session, set-face, status-request (clients),
heartbeat, session-started, speech, event (services).
Emits: session-opened, session-moved, status-report, done, error (clients), heartbeat-reply,
start-session, stop-session, flush-session, set-face (services), event, session-moved (subscribers).
"""

from __future__ import annotations

import heapq
import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.kind import KIND
from kouxing.services.control.registry import Refusal, Registry, ServiceRecord
from kouxing.services.control.sessions import SessionRecord, Sessions
from kouxing.services.kinds import PROVIDERS
from kouxing.shared.bus import COMMANDS
from kouxing.shared.clock import now_ns
from kouxing.shared.endpoints import split_endpoint, with_key
from kouxing.shared.errors import UserError
from kouxing.shared.keys import NO_PEER, Peer
from kouxing.shared.logs import LOG
from kouxing.shared.message_loop import Handler
from kouxing.shared.service import Service
from kouxing.shared.wire.codec import encoded_size
from kouxing.shared.wire.control import (
    AllowedKey,
    Event,
    EventName,
    Heartbeat,
    HeartbeatReply,
    SessionStarted,
    StartSession,
    StopSession,
)
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import (
    CloseSession,
    Done,
    Error,
    ErrorCode,
    FlushSession,
    OpenSession,
    ServiceState,
    SessionMoved,
    SessionState,
    StatusReport,
    StatusRequest,
)
from kouxing.shared.wire.speech import Speech

STOPPED = "stopped"  # why a service that shut down in order is gone
START_LIMIT_S = 5.0  # for the services to start a session
REPLACE_LIMIT_S = 20.0  # for another worker to take the place of a lost one
EXCUSED_S = 0.1  # without a tick: then control was busy or stopped, not the others
MAX_ANSWERS = 1000  # kept for repeated requests
MOVED_AGAIN_S = (1.0, 2.0, 4.0, 8.0)  # when a client is told again: its connection may have broken
TAKEOVER_S = 5.0  # in which a control that has just started learns what runs already
MAX_DEFERRED = 1000  # requests that wait for that
PAGE_BYTES = 512 * 1024  # of a status report, whose largest state leaves it within a message
FIRST_SESSION = 2**32  # number of the first session in the pages of a status report
MAY_BE_EARLY = (ErrorCode.UNKNOWN_SESSION, ErrorCode.NO_SERVICE)
FROM_SERVICES = (EventName.ERROR, EventName.RECORDED)  # events that a service may publish
Request = OpenSession | CloseSession | FlushSession | SetFace | StatusRequest


class ControlService(Service):
    """The control process."""

    kind = KIND

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config, has_control=False, extra_connections=config.max_sessions)
        self._registry = Registry(config.lost_after_s, config.max_load)
        self._sessions = Sessions(self._registry, config.max_sessions)
        self._idle_limit_s = config.idle_limit_s
        self._answers: OrderedDict[tuple[Peer, int, str | None], Message] = OrderedDict()
        self._num_events = 0
        self._ticked_s = time.monotonic()
        self._to_tell_again: list[tuple[float, str, SessionMoved]] = []  # a heap, by time
        self._takeover_end_s = self._ticked_s + TAKEOVER_S
        self._takes_over = True  # what an earlier control placed
        self._returning: dict[str, StartSession] = {}  # sessions that miss a service still
        self._observed: dict[str, Collection[str]] = {}  # sessions that observers follow meanwhile
        self._deferred: list[tuple[Handler, Request, Peer]] = []
        self._told_keys: dict[str, tuple[int, int]] = {}  # version of the list, by worker
        self._commands = self.bus.bind_router(config.bound_control, "control.control", COMMANDS)
        self._events = self.bus.bind_publisher(config.events, "control.events")
        own = self.key.public if self.key else ""
        self.endpoints = {
            name: with_key(config.reachable(socket.endpoint), own)
            for name, socket in (("commands", self._commands), ("events", self._events))
        }
        self.register(
            self._commands,
            {
                OpenSession: self._request_handler(self._open, "client"),
                CloseSession: self._request_handler(self._close, "client"),
                FlushSession: self._request_handler(self._flush, "client"),
                SetFace: self._request_handler(self._set_face, "client", "operator"),
                StatusRequest: self._request_handler(self._status),
                Heartbeat: self._on_heartbeat,
                SessionStarted: self._service_handler(self._on_started),
                Speech: self._service_handler(self._on_speech),
                Event: self._service_handler(self._on_service_event),
            },
        )
        self.register(self._events, {})

    def deliver_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Register control itself like any other service."""
        self._registry.add(heartbeat, NO_PEER, time.monotonic())

    def gauges(self) -> dict[str, float]:
        """Return how many sessions and services there are."""
        return {"sessions": len(self._sessions), "services": len(self._registry)}

    def on_tick(self, now_s: float) -> None:
        """Look for services without heartbeat, sessions that hang, and keys that changed."""
        pause_s, self._ticked_s = now_s - self._ticked_s, now_s
        if pause_s > EXCUSED_S:  # their heartbeats wait to be read
            self._registry.excuse(pause_s)
        if self.bus.zap is not None:
            self.bus.zap.refresh()
        if self._takes_over and now_s > self._takeover_end_s:
            self._end_takeover()
        for connection in self._commands.ended():
            if instance := self._registry.instance_at(connection):
                self._service_lost(instance, "its connection closed")
        for instance in self._registry.silent(now_s):
            self._service_lost(instance, "no heartbeat")
        while self._to_tell_again and self._to_tell_again[0][0] <= now_s:
            self._tell_again(heapq.heappop(self._to_tell_again)[2])
        for record in self._sessions.unsettled():
            if record.lost:
                if now_s - record.started_s > REPLACE_LIMIT_S:
                    lost = ", ".join(sorted(record.lost))
                    self._end(record, f"{lost} is lost and no other took its place")
            elif record.waiting_for and now_s - record.started_s > START_LIMIT_S:
                self._give_up_waiting(record)
            else:
                self._announce_if_started(record)

    def on_drain(self) -> bool:
        """Close every session."""
        for record in self._sessions:
            self._end(record, "control stops")
        return True

    def _new_keys(self, heartbeat: Heartbeat) -> dict[str, AllowedKey] | None:
        """Return the keys that may connect to a worker, if it does not have the newest list."""
        zap = self.bus.zap
        if zap is None or heartbeat.role != "worker":
            return None
        if self._told_keys.get(heartbeat.instance) == zap.version:
            return None
        self._told_keys[heartbeat.instance] = zap.version
        return {
            public: AllowedKey(name=grant.name, roles=list(grant.roles))
            for public, grant in zap.grants.items()
        }

    # --- requests ------------------------------------------------------------------------------

    def _request_handler(
        self, handle: Callable[[Any, Peer], Message | None], *roles: str
    ) -> Handler:
        """Return a handler that repeats its answer when a request is repeated.

        Where roles are given, only keys with one of them may ask.
        """

        def on_request(message: Request, sender: Peer) -> None:
            remembered = self._answers.get((sender, sender.connection, message.request))
            if remembered is not None:
                self._commands.send(remembered, to=sender)
                return
            reply: Message | None
            try:
                self._check_role(sender, *roles)
                reply = handle(message, sender)
            except Refusal as refusal:
                if refusal.code in MAY_BE_EARLY and self._defer(on_request, message, sender):
                    return
                self.metrics.count(f"refused_{refusal.code}")
                reply = Error(
                    session=message.session,
                    code=refusal.code,
                    text=refusal.text,
                    request=message.request,
                    retry_after_s=refusal.retry_after_s or None,
                )
            if reply is not None:
                self._reply(sender, message.request, reply)

        return on_request

    def _check_role(self, sender: Peer, *roles: str) -> None:
        """Refuse a sender whose key has none of some roles; with insecure = true nobody."""
        if self.bus.zap is None or not roles:
            return
        grant = self.bus.zap.grants.get(sender.key)
        if grant is None or not set(roles) & set(grant.roles):
            text = f"the key has no role {' or '.join(roles)}; see 'kouxing keys list'"
            raise Refusal(ErrorCode.NOT_ALLOWED, text)

    def _reply(self, sender: Peer, request: str | None, reply: Message) -> None:
        if request is not None and not isinstance(reply, StatusReport):
            self._answers[sender, sender.connection, request] = reply
            if len(self._answers) > MAX_ANSWERS:
                self._answers.popitem(last=False)
        self._commands.send(reply, to=sender)

    def _open(self, message: OpenSession, sender: Peer) -> Message | None:
        known = self._sessions.opened_by(message, sender)
        if known is not None and known.restored:
            return self._sessions.opened_message(known, self.endpoints["events"])
        if known is not None and not self._commands.is_open(known.client.connection):
            known.client = sender  # who was cut off, and waits here now
            if known.announced and known.next_sequence == 1:  # without the token no audio comes
                self._end(known, "its client was cut off before it was told")
                known = None
        if known is not None and not known.announced:
            return None  # the same request again while the services start
        record = self._sessions.open(message, sender, time.monotonic())
        LOG.info("session opened", extra={"session": record.name})
        self._start(record, record.waiting_for)
        return None

    def _close(self, message: CloseSession, _sender: Peer) -> Message:
        self._end(self._sessions.owned(message.session, message.token), "closed by its client")
        return Done(session=message.session, request=message.request)

    def _flush(self, message: FlushSession, _sender: Peer) -> Message:
        record = self._sessions.owned(message.session, message.token)
        self._send_to_participants(record, replace(message, epoch=record.epoch))
        self._publish(EventName.SESSION_FLUSHED, record.name)
        return Done(session=message.session, request=message.request)

    def _set_face(self, message: SetFace, _sender: Peer) -> Message | None:
        record = self._sessions.find(message.session)
        record.face.change(message.face, time.monotonic())
        self._send_to_participants(record, replace(message, epoch=record.epoch, request=None))
        if message.request is None:
            return None
        return Done(session=message.session, request=message.request)

    def _status(self, message: StatusRequest, sender: Peer) -> Message:
        """Return one page; sessions are numbered from ``FIRST_SESSION`` on, after the services."""
        now_s = time.monotonic()
        may_open = self._may_open(sender)
        if message.session:
            record = self._sessions.find(message.session)
            instances = self._sessions.participants(record)
            return StatusReport(
                request=message.request,
                services=[
                    self._service_state(self._registry[each], now_s, may_open=may_open)
                    for each in instances
                ],
                sessions=[self._sessions.state(record, now_s)],
            )
        services: list[ServiceState] = []
        sessions: list[SessionState] = []
        num_bytes = 0
        for number, each in self._status_from(message.after):
            if isinstance(each, SessionRecord):
                sessions.append(self._sessions.state(each, now_s))
                num_bytes += encoded_size(sessions[-1])
            else:
                services.append(self._service_state(each, now_s, may_open=may_open))
                num_bytes += encoded_size(services[-1])
            if num_bytes > PAGE_BYTES:
                return StatusReport(
                    request=message.request, services=services, sessions=sessions, next=number + 1
                )
        return StatusReport(request=message.request, services=services, sessions=sessions)

    def _status_from(self, number: int) -> Iterator[tuple[int, ServiceRecord | SessionRecord]]:
        if number < FIRST_SESSION:
            yield from enumerate(self._registry.sorted()[number:], number)
        for record in self._sessions.since(number - FIRST_SESSION):
            yield FIRST_SESSION + record.number, record

    def _may_open(self, asker: Peer) -> bool:
        """Return whether somebody may open sessions, or is a service: the page's token lets it."""
        if self.bus.zap is None:
            return True
        grant = self.bus.zap.grants.get(asker.key)
        return grant is not None and any(
            role == "client" or role.startswith("service:") for role in grant.roles
        )

    def _service_state(
        self, record: ServiceRecord, now_s: float, *, may_open: bool
    ) -> ServiceState:
        """Return what is told of a service; the token in a page's address only to who may open."""
        heartbeat = record.heartbeat
        endpoints = heartbeat.endpoints
        if not may_open:
            endpoints = {
                # a '#' in other endpoints is one of their key
                name: each.partition("#")[0] if each.startswith("http") else each
                for name, each in endpoints.items()
            }
        return ServiceState(
            service=heartbeat.service,
            instance=heartbeat.instance,
            role=heartbeat.role,
            state=record.state,
            age_s=self._registry.age_s(heartbeat.instance, now_s),
            clock_offset_ms=record.metrics.get("clock_offset_ms", 0.0),
            endpoints=endpoints,
            metrics=dict(record.metrics),
        )

    # --- from the services ---------------------------------------------------------------------

    def _service_handler(self, handle: Callable[[Any, str], None]) -> Handler:
        """Return a handler of what only registered services say; it is told which one."""

        def on_message(message: Message, sender: Peer) -> None:
            instance = self._registry.instance_of(sender)
            if instance:
                handle(message, instance)
            else:
                text = f"dropped a {message.kind} message: from no service"
                self.warn("no-service", text, message.session)

        return on_message

    def _on_heartbeat(self, heartbeat: Heartbeat, sender: Peer) -> None:
        received_ns = now_ns()
        try:
            self._check_role(sender, f"service:{heartbeat.service}")
            self._registry.check(heartbeat, sender)
            is_other = self._registry.differs(heartbeat, sender)
            if is_other or heartbeat.instance not in self._registry:
                _check_endpoints(heartbeat)
        except Refusal as refusal:
            self.warn(refusal.code, f"{heartbeat.instance}: {refusal.text}")
            self._commands.send(Error(code=refusal.code, text=refusal.text), to=sender)
            return
        if is_other:
            self._service_lost(heartbeat.instance, "it started again")
        is_new = heartbeat.instance not in self._registry
        if is_new and heartbeat.state == "draining":
            for session in heartbeat.sessions:  # those that others have taken over
                self._check_session(session, heartbeat, sender)
            return
        displaced = self._registry.displaced_by(heartbeat, sender) if is_new else ""
        self._registry.add(heartbeat, sender, time.monotonic())
        if self._takes_over and heartbeat.role == "observer":
            self._observed[heartbeat.instance] = heartbeat.sessions.keys()
        if is_new:
            is_back = self._registry.is_back(heartbeat.instance, sender) and not is_other
            self._on_new_service(heartbeat, sender, displaced, is_back=is_back)
        for session in heartbeat.sessions:
            self._check_session(session, heartbeat, sender)
        self._commands.send(  # last: a service that stood still has learnt by then what changed
            HeartbeatReply(
                sent_ns=heartbeat.sent_ns,
                received_ns=received_ns,
                replied_ns=now_ns(),
                control=self.instance,
                keys=self._new_keys(heartbeat),
            ),
            to=sender,
        )
        if heartbeat.state == "draining":
            self._service_lost(heartbeat.instance, STOPPED)

    def _on_new_service(
        self, heartbeat: Heartbeat, sender: Peer, displaced: str, *, is_back: bool
    ) -> None:
        """Give a new service the sessions that miss a worker, or those that it observes.

        One that was taken for lost goes on with its own, as if nothing had been.
        """
        self._publish(EventName.SERVICE_READY, detail=f"{heartbeat.service} {heartbeat.instance}")
        if displaced:
            self._service_lost(displaced, f"{heartbeat.instance} took its place")
        untold = []
        if is_back:
            untold = self._sessions.take_back(heartbeat.instance)
        self._restore_returning()
        for record in self._sessions.unsettled():
            if record.lost:
                self._replace(record)
        if heartbeat.role == "observer":
            untold = [each for each in self._sessions if each.name not in heartbeat.sessions]
        for record in untold:
            self._commands.send(self._sessions.start_message(record, time.monotonic()), to=sender)

    def _check_session(self, session: str, heartbeat: Heartbeat, sender: Peer) -> None:
        """Stop a session that a service should not serve, and end one without input."""
        record = self._sessions.get(session)
        if record is None and self._takes_over:
            return
        if record is not None and heartbeat.instance in record.lost:
            return  # nobody else serves it yet
        if record is None or not self._sessions.takes_part(record, heartbeat.instance):
            # just closed, or served by another now
            self._commands.send(StopSession(session=session), to=sender)
        elif self._sessions.take_input(record, heartbeat) > self._idle_limit_s:
            self._end(record, f"no audio for {self._idle_limit_s:g} s")

    def _on_started(self, started: SessionStarted, instance: str) -> None:
        if started.start is not None:
            self._on_served(started.start, instance)
            return
        record = self._sessions.get(started.session)
        if record is not None and started.request == record.start_request:
            self._start(record, self._sessions.take_started(record, instance, started.media_time))
            self._announce_if_started(record)

    def _on_speech(self, speech: Speech, instance: str) -> None:
        record = self._sessions.get(speech.session)
        if record is None or (record.epoch, record.workers["audio"]) != (speech.epoch, instance):
            return
        if not record.speaking:  # a recognizer that goes on says again that somebody speaks
            record.speech_time = speech.media_time
        record.speaking = speech.active
        name = EventName.SPEECH_START if speech.active else EventName.SPEECH_STOP
        self._publish(name, record.name, media_time=speech.media_time)

    def _on_service_event(self, event: Event, instance: str) -> None:
        if event.name in FROM_SERVICES:
            self._publish(EventName(event.name), event.session, detail=event.detail)
        else:
            self.warn("event", f"{instance} may not publish {event.name!r}", event.session)

    # --- sessions of an earlier control --------------------------------------------------------

    def _defer(self, handle: Handler, message: Request, sender: Peer) -> bool:
        """Keep a request about what is not known yet; return False if there is no point."""
        if not self._takes_over or len(self._deferred) >= MAX_DEFERRED:
            return False
        self._deferred.append((handle, message, sender))
        return True

    def _handle_deferred(self) -> None:
        deferred, self._deferred = self._deferred, []
        for handle, message, sender in deferred:
            handle(message, sender)

    def _on_served(self, start: StartSession, instance: str) -> None:
        """Take over a session that a recognizer serves since before this control started."""
        own = self._registry[instance].heartbeat.endpoints.get("audio")
        if not self._takes_over or own is None or start.endpoints.get("audio") != own:
            self.warn("no-takeover", f"{instance} may not bring this session", start.session)
        elif self._sessions.get(start.session) is None:
            self._returning[start.session] = start
            self._restore_returning()

    def _restore_returning(self) -> None:
        """Take over the sessions whose workers all run, at the end of the time all others, too."""
        for name, start in list(self._returning.items()):
            is_complete = all(self._registry.provider(*each) for each in start.endpoints.items())
            if is_complete or not self._takes_over:
                del self._returning[name]
                self._restore(start)
        self._handle_deferred()

    def _restore(self, start: StartSession) -> None:
        record = self._sessions.restore(start, time.monotonic())
        LOG.info("session taken over", extra={"session": record.name})
        uninformed = {
            instance
            for instance in self._registry.observers()
            if record.name not in self._observed.get(instance, ())
        }
        self._start(record, record.waiting_for | uninformed)  # workers: if some knew a later epoch
        if record.lost:
            self._replace(record)

    def _end_takeover(self) -> None:
        self._takes_over = False
        self._restore_returning()
        self._observed.clear()

    # --- sessions ------------------------------------------------------------------------------

    def _start(self, record: SessionRecord, instances: set[str]) -> None:
        start = self._sessions.start_message(record, time.monotonic())
        for instance in instances:
            self._commands.send(start, to=self._registry[instance].peer)

    def _send_to_participants(self, record: SessionRecord, message: Message) -> None:
        for instance in self._sessions.participants(record):
            self._commands.send(message, to=self._registry[instance].peer)

    def _announce_if_started(self, record: SessionRecord) -> None:
        """Tell the client that its session is open, or that it moved, once its services serve it.

        A new session waits for the observers, so that they miss nothing of it. One that moved goes
        on at once: its client still has audio to send again.
        """
        if record.lost:
            return
        if not record.announced and not record.waiting_for:
            record.announced, record.moved = True, False
            self._publish(EventName.SESSION_OPENED, record.name)
            opened = self._sessions.opened_message(record, self.endpoints["events"])
            self._reply(record.client, record.opening.request, opened)
        elif record.moved and record.announced and not self._missing_workers(record):
            moved = self._sessions.moved_message(record)
            record.moved, record.resume_sequence = False, 0
            self._commands.send(moved, to=record.client)
            self._events.send(moved)
            self._publish(EventName.SESSION_MOVED, record.name)
            workers = ", ".join(sorted({*record.workers.values()}))
            LOG.info("session moved to %s", workers, extra={"session": record.name})
            now_s = time.monotonic()
            for delay_s in MOVED_AGAIN_S:
                heapq.heappush(self._to_tell_again, (now_s + delay_s, record.name, moved))

    def _tell_again(self, moved: SessionMoved) -> None:
        """Tell a client again where its session is, unless that has changed."""
        record = self._sessions.get(moved.session)
        if record is not None and record.epoch == moved.epoch:
            self._commands.send(moved, to=record.client)

    def _give_up_waiting(self, record: SessionRecord) -> None:
        """Go on without the observers that did not start a session, but not without a worker."""
        missing = self._missing_workers(record)
        if not missing:
            record.waiting_for.clear()
            self._announce_if_started(record)
            return
        text = f"{', '.join(sorted(missing))} did not start the session in {START_LIMIT_S:g} s"
        if not record.announced:
            request = record.opening.request
            reply = Error(session=record.name, code=ErrorCode.TIMEOUT, text=text, request=request)
            self._reply(record.client, request, reply)
        self._end(record, text)

    def _missing_workers(self, record: SessionRecord) -> set[str]:
        return record.waiting_for & {*record.workers.values()}

    def _replace(self, record: SessionRecord) -> None:
        if self._sessions.replace(record, time.monotonic()):
            self._start(record, record.waiting_for - record.held_back)

    def _service_lost(self, instance: str, reason: str) -> None:
        self._registry.remove(instance)
        self._told_keys.pop(instance, None)
        LOG.log(
            logging.INFO if reason == STOPPED else logging.WARNING, "lost %s: %s", instance, reason
        )
        self._publish(EventName.SERVICE_LOST, detail=f"{instance}: {reason}")
        for record in self._sessions.lose(instance, time.monotonic()):
            self._replace(record)

    def _end(self, record: SessionRecord, reason: str) -> None:
        self._send_to_participants(record, StopSession(session=record.name, epoch=record.epoch))
        self._sessions.remove(record, time.monotonic())
        self._publish(EventName.SESSION_CLOSED, record.name, detail=reason)
        LOG.info("session closed: %s", reason, extra={"session": record.name})

    def _publish(
        self, name: EventName, session: str = "", *, detail: str = "", media_time: int = 0
    ) -> None:
        self._num_events += 1
        self.metrics.count(f"event_{name}")
        self._events.send(
            Event(
                session=session,
                sequence=self._num_events,
                media_time=media_time,
                name=name,
                detail=detail[:2000],
            )
        )


def _check_endpoints(heartbeat: Heartbeat) -> None:
    """Check that a worker may provide what it does, and that others can connect there.

    Raises
    ------
    Refusal
        If an endpoint is none, or another kind of service provides it.
    """
    if heartbeat.role != "worker":
        return
    if not heartbeat.endpoints:
        raise Refusal(ErrorCode.BAD_MESSAGE, "a worker must name the endpoints that it provides")
    for name, endpoint in heartbeat.endpoints.items():
        if PROVIDERS.get(name, heartbeat.service) != heartbeat.service:
            text = f"{name} is what a {PROVIDERS[name]} provides, not a {heartbeat.service}"
            raise Refusal(ErrorCode.NOT_ALLOWED, text)
        try:
            host, port = split_endpoint(endpoint, name)
        except UserError as error:
            raise Refusal(ErrorCode.BAD_MESSAGE, str(error)) from None
        if "*" in (host, port):
            text = f"{name}: {endpoint!r} names no host or port to connect to"
            raise Refusal(ErrorCode.BAD_MESSAGE, text)
