"""Control: opens sessions, hands out endpoints, passes speech events on, knows who is alive.

Li et al. 2011, section 2: the control module initialises the others, passes messages between them
and keeps them in step. Audio, phones and FAPs never pass through it.

Reacts to: open-session, close-session, flush-session, choose-lips, express,
choose-expressiveness, status-request (clients), heartbeat, done, speech, recorded, error
(services).
Emits: session-opened, session-moved, status-report, done, error (clients), heartbeat-seen,
allowed-keys, start-session, stop-session, flush-now, use-lips, express, choose-expressiveness
(services), event, session-moved (subscribers).
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from services.control.config import ControlConfig
from services.control.registry import PROVIDERS, Refusal, Registry
from services.control.sessions import SessionRecord, Sessions
from shared.bus import COMMANDS
from shared.clock import now_ns
from shared.endpoints import reachable, split_endpoint, with_key
from shared.errors import UserError
from shared.keys import NOBODY, Peer
from shared.logs import LOG
from shared.service import Handler, Service
from shared.wire.control import (
    AllowedKey,
    AllowedKeys,
    Event,
    EventName,
    FlushNow,
    Heartbeat,
    HeartbeatSeen,
    Recorded,
    ServiceState,
    StatusReport,
    StatusRequest,
    StopSession,
    UseLips,
)
from shared.wire.message import Message
from shared.wire.session import (
    ChooseExpressiveness,
    ChooseLips,
    CloseSession,
    Done,
    Error,
    ErrorCode,
    Express,
    FlushSession,
    OpenSession,
)
from shared.wire.speech import Speech
from shared.zap import Zap

STOPPED = "stopped"  # why a service that shut down in order is gone
START_LIMIT_S = 5.0  # for the services to start a session
REPLACE_LIMIT_S = 20.0  # for another worker to take the place of a lost one
EXCUSED_S = 0.5  # without a tick: then control was busy or stopped, not the others
MAX_ANSWERS = 1000  # kept for repeated requests
Request = (
    OpenSession
    | CloseSession
    | FlushSession
    | ChooseLips
    | Express
    | ChooseExpressiveness
    | StatusRequest
)


class ControlService(Service):
    """The control process."""

    name = "control"
    role = "control"

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config, control=False)
        self._registry = Registry(config.lost_after_s)
        self._sessions = Sessions(self._registry, config.max_sessions)
        self._idle_limit_s = config.idle_limit_s
        self._answers: OrderedDict[tuple[Peer, int, str], Message] = OrderedDict()
        self._num_events = 0
        self._ticked_s = time.monotonic()
        self._told_version = (0, 0)  # of the allowed keys
        self._commands = self.bus.bind_router(config.commands, "control.commands", COMMANDS)
        self._events = self.bus.bind_publisher(config.events, "control.events")
        own = self.key.public if self.key else ""
        self.endpoints = {
            name: with_key(reachable(socket.endpoint, config.advertise, f"control.{name}"), own)
            for name, socket in (("commands", self._commands), ("events", self._events))
        }
        self.register(
            self._commands,
            {
                OpenSession: self._request_handler(self._open, "client"),
                CloseSession: self._request_handler(self._close, "client"),
                FlushSession: self._request_handler(self._flush, "client"),
                ChooseLips: self._request_handler(self._choose_lips, "client"),
                Express: self._request_handler(self._pass_on, "client", "operator"),
                ChooseExpressiveness: self._request_handler(self._pass_on, "client", "operator"),
                StatusRequest: self._request_handler(self._status),
                Heartbeat: self._on_heartbeat,
                Done: self._service_handler(self._on_started),
                Speech: self._service_handler(self._on_speech),
                Recorded: self._service_handler(self._on_recorded),
                Error: self._service_handler(self._on_service_error),
            },
        )
        self.register(self._events, {})

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        """Register control itself like any other service."""
        self._registry.add(heartbeat, NOBODY, time.monotonic())

    def on_tick(self, now_s: float) -> None:
        """Look for services without heartbeat, sessions that hang, and keys that changed."""
        pause_s, self._ticked_s = now_s - self._ticked_s, now_s
        if pause_s > EXCUSED_S:  # their heartbeats wait to be read
            self._registry.excuse(pause_s)
        if self.bus.zap is not None:
            self._tell_new_keys(self.bus.zap)
        for instance in self._registry.silent(now_s):
            self._service_lost(instance, "no heartbeat")
        for record in self._sessions:
            lost = self._sessions.lost_workers(record)
            if lost and now_s - record.started_s > REPLACE_LIMIT_S:
                self._end(record, f"{', '.join(lost)} is lost and no other took its place")
            elif record.waiting_for and now_s - record.started_s > START_LIMIT_S:
                self._give_up_waiting(record)
            else:
                self._announce_if_started(record)

    def on_drain(self) -> bool:
        """Close every session."""
        for record in self._sessions:
            self._end(record, "control stops")
        return True

    def _tell_new_keys(self, zap: Zap) -> None:
        """Tell every service who may connect, when that has changed."""
        zap.refresh()
        if zap.version != self._told_version:
            self._told_version = zap.version
            for _, record in self._registry.sorted():
                if record.heartbeat.role == "worker":
                    self._tell_keys(zap, record.peer)

    def _tell_keys(self, zap: Zap, service: Peer) -> None:
        keys = {
            public: AllowedKey(name=guest.name, roles=list(guest.roles))
            for public, guest in zap.guests.items()
        }
        self._commands.send(AllowedKeys(keys=keys), to=service)

    # --- requests ------------------------------------------------------------------------------

    def _request_handler(
        self, handle: Callable[[Any, Peer], Message | None], *roles: str
    ) -> Handler:
        """Return a handler that repeats its answer when a request is repeated.

        Where roles are given, only keys with one of them may ask.
        """

        def on_request(message: Request, sender: Peer) -> None:
            remembered = self._answers.get(_asker(sender, message.request))
            if remembered is not None:
                self._commands.send(remembered, to=sender)
                return
            reply: Message | None
            try:
                self._check_role(sender, *roles)
                reply = handle(message, sender)
            except Refusal as refusal:
                self.metrics.count(f"refused_{refusal.code}")
                reply = Error(
                    session=message.session,
                    code=refusal.code,
                    text=refusal.text,
                    request=message.request,
                )
            if reply is not None:
                self._reply(sender, message.request, reply)

        return on_request

    def _check_role(self, sender: Peer, *roles: str) -> None:
        """Refuse a sender whose key has none of some roles; with insecure = true nobody."""
        if self.bus.zap is None or not roles:
            return
        guest = self.bus.zap.guests.get(sender.key)
        if guest is None or not set(roles) & set(guest.roles):
            text = f"the key has no role {' or '.join(roles)}; see 'kouxing keys list'"
            raise Refusal(ErrorCode.NOT_ALLOWED, text)

    def _reply(self, sender: Peer, request: str, reply: Message) -> None:
        if not isinstance(reply, StatusReport):
            self._answers[_asker(sender, request)] = reply
            if len(self._answers) > MAX_ANSWERS:
                self._answers.popitem(last=False)
        self._commands.send(reply, to=sender)

    def _open(self, message: OpenSession, sender: Peer) -> None:
        starting = (record for record in self._sessions if not record.announced)
        if any((record.client, record.opening) == (sender, message) for record in starting):
            return  # the same request again while the services start
        record = self._sessions.open(message, sender, time.monotonic())
        LOG.info("session opened", extra={"session": record.name})
        self._start(record)

    def _close(self, message: CloseSession, _sender: Peer) -> Message:
        self._end(self._sessions.owned(message.session, message.token), "closed by its client")
        return Done(session=message.session, request=message.request)

    def _flush(self, message: FlushSession, _sender: Peer) -> Message:
        record = self._sessions.owned(message.session, message.token)
        self._send_to_participants(record, FlushNow(session=record.name, epoch=record.epoch))
        self._publish(EventName.SESSION_FLUSHED, record.name)
        return Done(session=message.session, request=message.request)

    def _choose_lips(self, message: ChooseLips, _sender: Peer) -> Message:
        record = self._sessions.owned(message.session, message.token)
        record.lips = message.lips
        use = UseLips(session=record.name, epoch=record.epoch, lips=message.lips)
        self._send_to_participants(record, use)
        return Done(session=message.session, request=message.request)

    def _pass_on(self, message: Express | ChooseExpressiveness, _sender: Peer) -> Message:
        self._send_to_participants(self._sessions.find(message.session), message)
        return Done(session=message.session, request=message.request)

    def _status(self, message: StatusRequest, _sender: Peer) -> Message:
        now_s = time.monotonic()
        return StatusReport(
            request=message.request,
            services=[
                ServiceState(
                    service=record.heartbeat.service,
                    instance=instance,
                    role=record.heartbeat.role,
                    state=record.heartbeat.state,
                    age_s=now_s - record.received_s,
                    clock_offset_ms=record.heartbeat.metrics.get("clock_offset_ms", 0.0),
                    endpoints=record.heartbeat.endpoints,
                    metrics=record.heartbeat.metrics,
                )
                for instance, record in self._registry.sorted()
            ],
            sessions=[self._sessions.state(record, now_s) for record in self._sessions],
        )

    # --- from the services ---------------------------------------------------------------------

    def _service_handler(self, handle: Callable[[Any, str], None]) -> Handler:
        """Return a handler of what only registered services say; it is told which one."""

        def on_message(message: Message, sender: Peer) -> None:
            instance = self._registry.instance_of(sender)
            if instance:
                handle(message, instance)
            else:
                self.warn("no-service", f"dropped a {message.kind} message: from no service")

        return on_message

    def _on_heartbeat(self, heartbeat: Heartbeat, sender: Peer) -> None:
        received_ns = now_ns()
        try:
            self._check_role(sender, f"service:{heartbeat.service}")
            self._registry.check(heartbeat, sender)
            if heartbeat.role == "worker":
                heartbeat = replace(heartbeat, endpoints=_keyed_endpoints(heartbeat, sender.key))
        except Refusal as refusal:
            self.warn(refusal.code, f"{heartbeat.instance}: {refusal.text}")
            self._commands.send(Error(code=refusal.code, text=refusal.text), to=sender)
            return
        if self._registry.differs(heartbeat):
            self._service_lost(heartbeat.instance, "it started again")
        is_new = heartbeat.instance not in self._registry
        if is_new and heartbeat.state == "draining":
            return
        self._registry.add(heartbeat, sender, time.monotonic())
        self._commands.send(
            HeartbeatSeen(sent_ns=heartbeat.sent_ns, received_ns=received_ns, replied_ns=now_ns()),
            to=sender,
        )
        if is_new:
            if self.bus.zap is not None and heartbeat.role == "worker":
                self._tell_keys(self.bus.zap, sender)
            self._on_new_service(heartbeat)
        for session in heartbeat.sessions:
            self._check_session(session, heartbeat, sender)
        if heartbeat.state == "draining":
            self._service_lost(heartbeat.instance, STOPPED)

    def _on_new_service(self, heartbeat: Heartbeat) -> None:
        """Give a new service the sessions that miss a worker, or those that it observes."""
        self._publish(EventName.SERVICE_READY, detail=f"{heartbeat.service} {heartbeat.instance}")
        for instance in self._registry.displaced_by(heartbeat):
            self._service_lost(instance, f"{heartbeat.instance} took its place")
        for record in self._sessions:
            if self._sessions.lost_workers(record):
                self._replace(record)
            elif heartbeat.role == "observer":
                start = self._sessions.start_message(record)
                self._commands.send(start, to=self._registry[heartbeat.instance].peer)

    def _check_session(self, session: str, heartbeat: Heartbeat, sender: Peer) -> None:
        """Stop a session that a service should not serve, and end one without input."""
        record = self._sessions.get(session)
        if record is None or heartbeat.instance not in self._sessions.participants(record):
            # of an earlier run of control, just closed, or served by another now
            self._commands.send(StopSession(session=session), to=sender)
        elif self._sessions.take_input(record, heartbeat) > self._idle_limit_s:
            self._end(record, f"no audio for {self._idle_limit_s:g} s")

    def _on_started(self, done: Done, instance: str) -> None:
        record = self._sessions.get(done.session)
        if record is not None and done.request == record.start_request:
            record.waiting_for.discard(instance)
            self._announce_if_started(record)

    def _on_speech(self, speech: Speech, instance: str) -> None:
        record = self._sessions.get(speech.session)
        if record is None or (record.epoch, record.workers["audio"]) != (speech.epoch, instance):
            return
        record.speaking = speech.active
        name = EventName.SPEECH_START if speech.active else EventName.SPEECH_STOP
        self._publish(name, record.name, media_time=speech.media_time)

    def _on_recorded(self, recorded: Recorded, _instance: str) -> None:
        self._publish(EventName.RECORDED, recorded.session, detail=recorded.path)

    def _on_service_error(self, error: Error, _instance: str) -> None:
        self._publish(EventName.ERROR, error.session, detail=f"{error.code}: {error.text}")

    # --- sessions ------------------------------------------------------------------------------

    def _start(self, record: SessionRecord) -> None:
        self._send_to_participants(record, self._sessions.start_message(record))

    def _send_to_participants(self, record: SessionRecord, message: Message) -> None:
        for instance in self._sessions.participants(record):
            self._commands.send(message, to=self._registry[instance].peer)

    def _announce_if_started(self, record: SessionRecord) -> None:
        """Tell the client that its session is open, or that it moved, once its services serve it.

        A new session waits for the observers, so that they miss nothing of it. One that moved goes
        on at once: its client still has audio to send again.
        """
        if self._sessions.lost_workers(record):
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
            self._start(record)

    def _service_lost(self, instance: str, reason: str) -> None:
        self._registry.remove(instance)
        LOG.log(
            logging.INFO if reason == STOPPED else logging.WARNING, "lost %s: %s", instance, reason
        )
        self._publish(EventName.SERVICE_LOST, detail=f"{instance}: {reason}")
        for record in self._sessions:
            record.waiting_for.discard(instance)
            if instance in record.workers.values():
                record.started_s = time.monotonic()
                self._replace(record)

    def _end(self, record: SessionRecord, reason: str) -> None:
        self._send_to_participants(record, StopSession(session=record.name, epoch=record.epoch))
        self._sessions.remove(record)
        self._publish(EventName.SESSION_CLOSED, record.name, detail=reason)
        LOG.info("session closed: %s", reason, extra={"session": record.name})

    def _publish(
        self, name: EventName, session: str = "", *, detail: str = "", media_time: int = 0
    ) -> None:
        self._num_events += 1
        self._events.send(
            Event(
                session=session,
                sequence=self._num_events,
                number=self._num_events,
                media_time=media_time,
                name=name,
                detail=detail[:2000],
            )
        )


def _asker(sender: Peer, request: str) -> tuple[Peer, int, str]:
    """Return who may have the answer to a request again: its sender, on the same connection."""
    return sender, sender.connection, request


def _keyed_endpoints(heartbeat: Heartbeat, key: str) -> dict[str, str]:
    """Return what a worker provides with its key, once others may connect there.

    Raises
    ------
    Refusal
        If an endpoint is none, or another kind of service provides it.
    """
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
    return {name: with_key(each, key) for name, each in heartbeat.endpoints.items()}
