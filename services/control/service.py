"""Control: opens sessions, hands out endpoints, passes speech events on, knows who is alive.

Li et al. 2011, section 2: the control module initialises the others, passes messages between them
and keeps them in step. Audio, phones and FAPs never pass through it.
"""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from services.control.sessions import ENDPOINTS, REQUIRED, Refusal, Registry, SessionRecord
from shared.bus import split_endpoint
from shared.clock import now_ns
from shared.config import ControlConfig, reachable
from shared.errors import UserError
from shared.logs import LOG
from shared.messages import (
    CloseSession,
    Done,
    Error,
    Event,
    FlushNow,
    FlushSession,
    Heartbeat,
    HeartbeatSeen,
    Message,
    OpenSession,
    Recorded,
    ServiceState,
    SessionState,
    Speech,
    StartSession,
    StatusReport,
    StatusRequest,
    StopSession,
)
from shared.service import Handler, Service

STOPPED = "stopped"  # why a service is gone that said goodbye
START_LIMIT_S = 5.0  # for the services to take a session
REPLACE_LIMIT_S = 20.0  # for a lost recognizer or synthesizer to come back
Request = OpenSession | CloseSession | FlushSession | StatusRequest

NUM_REMEMBERED = 1000  # answers kept for repeated requests


class ControlService(Service):
    """The control process."""

    name = "control"

    def __init__(self, config: ControlConfig) -> None:
        super().__init__(config, control=False)
        self._registry = Registry(config.max_sessions, config.lost_after_s)
        self._idle_limit_s = config.idle_limit_s
        self._answers: OrderedDict[tuple[bytes, str], Message] = OrderedDict()
        self._num_events = 0
        self._commands = self.bus.bind_router(config.commands, "control.commands")
        self._events = self.bus.bind_publisher(config.events, "control.events")
        self.endpoints = {
            "commands": reachable(self._commands.endpoint, config.advertise, "control.commands"),
            "events": reachable(self._events.endpoint, config.advertise, "control.events"),
        }
        self.listen(
            self._commands,
            {
                OpenSession: self._answering(self._open),
                CloseSession: self._answering(self._close),
                FlushSession: self._answering(self._flush),
                StatusRequest: self._answering(self._status),
                Heartbeat: self._on_heartbeat,
                Done: self._on_started,
                Speech: self._on_speech,
                Recorded: self._on_recorded,
                Error: self._on_error_from,
            },
        )
        self.listen(self._events, {})

    def on_heartbeat_due(self, heartbeat: Heartbeat) -> None:
        """Register control itself like any other service."""
        self._registry.beat(heartbeat, b"", time.monotonic())

    def on_tick(self, now_s: float) -> None:
        """Look for services that went silent and sessions that hang or idle."""
        for instance in self._registry.silent(now_s):
            self._service_gone(instance, "no heartbeat")
        for record in list(self._registry.sessions.values()):
            absent = [service for service in REQUIRED if not self._registry.serves(record, service)]
            if absent and now_s - record.started_s > REPLACE_LIMIT_S:
                self._end(record, f"the {' and the '.join(absent)} is lost")
            elif not record.announced and not record.waiting_for:
                self._announce(record)  # the last one that was waited for is gone
            elif record.waiting_for and now_s - record.started_s > START_LIMIT_S:
                self._give_up_waiting(record)

    def on_drain(self) -> bool:
        """Close every session."""
        for record in list(self._registry.sessions.values()):
            self._end(record, "control stops")
        return True

    # --- requests ------------------------------------------------------------------------------

    def _answering(self, handle: Callable[[Any, bytes], Message | None]) -> Handler:
        """Return a handler that answers: with the same words to a repeated request."""

        def answer(message: Request, sender: bytes) -> None:
            remembered = self._answers.get((sender, message.request))
            if remembered is not None:
                self._commands.send(remembered, to=sender)
                return
            reply: Message | None
            try:
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

        return answer

    def _reply(self, sender: bytes, request: str, reply: Message) -> None:
        if not isinstance(reply, StatusReport):
            self._answers[sender, request] = reply
            if len(self._answers) > NUM_REMEMBERED:
                self._answers.popitem(last=False)
        self._commands.send(reply, to=sender)

    def _open(self, message: OpenSession, sender: bytes) -> None:
        pending = self._registry.sessions.values()
        if any((record.client, record.opening) == (sender, message) for record in pending):
            return  # the same request again while its services start
        record = self._registry.open(message, sender, time.monotonic())
        LOG.info("session opened", extra={"session": record.name})
        self._start(record)

    def _close(self, message: CloseSession, _sender: bytes) -> Message:
        self._end(self._registry.owned(message.session, message.token), "closed by its client")
        return Done(session=message.session, request=message.request)

    def _flush(self, message: FlushSession, _sender: bytes) -> Message:
        record = self._registry.owned(message.session, message.token)
        self._tell(record, FlushNow(session=record.name, epoch=record.epoch))
        self._publish("session-flushed", record.name)
        return Done(session=message.session, request=message.request)

    def _status(self, message: StatusRequest, _sender: bytes) -> Message:
        now_s = time.monotonic()
        return StatusReport(
            request=message.request,
            services=[
                ServiceState(
                    service=record.heartbeat.service,
                    instance=instance,
                    state=record.heartbeat.state,
                    age_s=now_s - record.heard_s,
                    clock_offset_ms=record.heartbeat.metrics.get("clock_offset_ms", 0.0),
                    endpoints=record.heartbeat.endpoints,
                    metrics=record.heartbeat.metrics,
                )
                for instance, record in sorted(self._registry.services.items())
            ],
            sessions=[
                SessionState(
                    session=record.name,
                    state="open" if record.announced else "starting",
                    age_s=self._registry.age_s(record),
                    speaking=record.speaking,
                    recognizer=record.recognizer,
                    synthesizer=record.synthesizer,
                )
                for record in self._registry.sessions.values()
            ],
        )

    # --- from the services ---------------------------------------------------------------------

    def _on_heartbeat(self, heartbeat: Heartbeat, sender: bytes) -> None:
        received_ns = now_ns()
        problem = _wrong_endpoints(heartbeat)
        if problem:
            self.warn("endpoints", f"{heartbeat.instance}: {problem}")
            self._commands.send(Error(code="bad-message", text=problem), to=sender)
            return
        is_new = heartbeat.instance not in self._registry.services
        if is_new and heartbeat.state == "draining":
            return
        if is_new:
            for instance in self._registry.displaced_by(heartbeat):
                self._service_gone(instance, f"{heartbeat.instance} took its place")
        self._registry.beat(heartbeat, sender, time.monotonic())
        self._commands.send(
            HeartbeatSeen(sent_ns=heartbeat.sent_ns, received_ns=received_ns, replied_ns=now_ns()),
            to=sender,
        )
        if is_new:
            self._publish("service-ready", detail=f"{heartbeat.service} {heartbeat.instance}")
            self._take_over(heartbeat)
        if heartbeat.state == "draining":
            self._service_gone(heartbeat.instance, STOPPED)
        for session, idle_s in heartbeat.idle_s.items():
            record = self._registry.sessions.get(session)
            if record is None or not self._registry.takes_part(heartbeat, record):
                # of an earlier run of control, just closed, or served by another now
                self._commands.send(StopSession(session=session), to=sender)
            elif heartbeat.instance == record.recognizer and idle_s > self._idle_limit_s:
                self._end(record, f"no audio for {self._idle_limit_s:g} s")

    def _on_started(self, done: Done, sender: bytes) -> None:
        record = self._registry.sessions.get(done.session)
        if record is None or done.request != _start_request(record):
            return
        started = {
            instance
            for instance in record.waiting_for
            if instance in self._registry.services
            and self._registry.services[instance].address == sender
        }
        if started:
            record.waiting_for -= started
            if not record.waiting_for:
                self._announce(record)

    def _on_speech(self, speech: Speech, _sender: bytes) -> None:
        record = self._registry.sessions.get(speech.session)
        if record is not None and record.epoch == speech.epoch:
            record.speaking = speech.active
            name = "speech-start" if speech.active else "speech-stop"
            self._publish(name, record.name, media_time=speech.media_time)

    def _on_recorded(self, recorded: Recorded, _sender: bytes) -> None:
        self._publish("recorded", recorded.session, detail=recorded.path)

    def _on_error_from(self, error: Error, _sender: bytes) -> None:
        self._publish("error", error.session, detail=f"{error.code}: {error.text}")

    # --- inside ----------------------------------------------------------------------------------

    def _start(self, record: SessionRecord, only: str = "") -> None:
        endpoints = {
            service: self._registry.services[getattr(record, service)].heartbeat.endpoints
            for service in REQUIRED
        }
        message = StartSession(
            session=record.name,
            epoch=record.epoch,
            request=_start_request(record),
            token=record.token,
            encoding=record.opening.encoding,
            sample_rate_hz=record.opening.sample_rate_hz,
            num_channels=record.opening.num_channels,
            record=record.opening.record,
            paced=record.opening.paced,
            phone_input=endpoints["synthesizer"]["phone_input"],
            phones=endpoints["recognizer"]["phones"],
            faps=endpoints["synthesizer"]["faps"],
        )
        if only:
            self._commands.send(message, to=self._registry.services[only].address)
        else:
            self._tell(record, message)

    def _tell(self, record: SessionRecord, message: Message) -> None:
        for instance in self._registry.participants(record):
            address = self._registry.services[instance].address
            if address:
                self._commands.send(message, to=address)
            else:
                record.waiting_for.discard(instance)

    def _announce(self, record: SessionRecord) -> None:
        if record.announced or not all(self._registry.serves(record, s) for s in REQUIRED):
            return
        record.announced = True
        self._publish("session-opened", record.name)
        opened = self._registry.opened(record, self.endpoints["events"])
        self._reply(record.client, record.opening.request, opened)

    def _give_up_waiting(self, record: SessionRecord) -> None:
        missing = record.waiting_for & {record.recognizer, record.synthesizer}
        if not missing:
            record.waiting_for.clear()
            self._announce(record)
            return
        text = f"{', '.join(sorted(missing))} did not start the session in {START_LIMIT_S:g} s"
        reply = Error(
            session=record.name, code="timeout", text=text, request=record.opening.request
        )
        if not record.announced:
            self._reply(record.client, record.opening.request, reply)
        self._end(record, text)

    def _take_over(self, heartbeat: Heartbeat) -> None:
        """Give a service that just came the sessions that miss one, or that it observes."""
        for record in list(self._registry.sessions.values()):
            if not all(self._registry.serves(record, service) for service in REQUIRED):
                self._replace(record)
            elif heartbeat.service not in REQUIRED:
                self._start(record, only=heartbeat.instance)

    def _replace(self, record: SessionRecord) -> None:
        if self._registry.replace(record, time.monotonic()):
            self._start(record)
            self._publish("session-moved", record.name)

    def _service_gone(self, instance: str, reason: str) -> None:
        self._registry.services.pop(instance, None)
        LOG.log(
            logging.INFO if reason == STOPPED else logging.WARNING, "lost %s: %s", instance, reason
        )
        self._publish("service-lost", detail=f"{instance}: {reason}")
        for record in list(self._registry.sessions.values()):
            record.waiting_for.discard(instance)
            if instance in (record.recognizer, record.synthesizer):
                record.started_s = time.monotonic()
                self._replace(record)

    def _end(self, record: SessionRecord, reason: str) -> None:
        self._tell(record, StopSession(session=record.name, epoch=record.epoch))
        del self._registry.sessions[record.name]
        self._publish("session-closed", record.name, detail=reason)
        LOG.info("session closed: %s", reason, extra={"session": record.name})

    def _publish(
        self, name: str, session: str = "", *, detail: str = "", media_time: int = 0
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


def _start_request(record: SessionRecord) -> str:
    return f"start-{record.name}-{record.epoch}"


def _wrong_endpoints(heartbeat: Heartbeat) -> str:
    """Return what is wrong with the endpoints that others are to connect to, if anything."""
    for key in ENDPOINTS.get(heartbeat.service, ()):
        endpoint = heartbeat.endpoints.get(key, "")
        try:
            host, port = split_endpoint(endpoint, key)
        except UserError as error:
            return str(error)
        if "*" in (host, port):
            return f"{key}: {endpoint!r} names no host or port to connect to"
    return ""
