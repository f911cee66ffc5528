"""Sessions and services as control knows them; no sockets, so every rule can be tested."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass, field

from shared.messages import Heartbeat, OpenSession, SessionOpened

REQUIRED = ("recognizer", "synthesizer")  # one of each serves a session
OBSERVERS = ("driver", "gateway")  # all of them take part
ENDPOINTS = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}


@dataclass(slots=True)
class ServiceRecord:
    """One running service."""

    address: bytes  # its identity on control's socket
    heartbeat: Heartbeat  # the newest
    heard_s: float


@dataclass(slots=True)
class SessionRecord:
    """One session."""

    name: str
    token: str
    opening: OpenSession
    client: bytes  # who asked, on control's socket
    opened_s: float
    started_s: float  # when its services were last told to start it, or one was lost
    recognizer: str
    synthesizer: str
    audio: str  # the endpoint that the client was given
    epoch: int = 1
    waiting_for: set[str] = field(default_factory=set)  # instances that have not started it yet
    announced: bool = False  # the client was told
    speaking: bool = False


class Refusal(Exception):
    """A request that cannot be met; ``code`` is one of PROTOCOL.md's."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code
        self.text = text


class Registry:
    """Which services are alive and which sessions they serve."""

    def __init__(self, max_sessions: int, lost_after_s: float) -> None:
        self.services: dict[str, ServiceRecord] = {}
        self.sessions: dict[str, SessionRecord] = {}
        self._max_sessions = max_sessions
        self._lost_after_s = lost_after_s

    def beat(self, heartbeat: Heartbeat, address: bytes, now_s: float) -> None:
        """Take a heartbeat."""
        self.services[heartbeat.instance] = ServiceRecord(address, heartbeat, now_s)

    def displaced_by(self, heartbeat: Heartbeat) -> list[str]:
        """Return the instances that a new one has taken the endpoints of: they have crashed."""
        return [
            instance
            for instance, record in self.services.items()
            if heartbeat.service in REQUIRED
            and record.heartbeat.service == heartbeat.service
            and record.heartbeat.endpoints == heartbeat.endpoints
        ]

    def silent(self, now_s: float) -> list[str]:
        """Return the instances whose loop has not been heard for too long."""
        return [
            instance
            for instance, record in self.services.items()
            if record.address and now_s - record.heard_s > self._lost_after_s
        ]

    def ready(self, service: str) -> list[str]:
        """Return the instances of a service that take new sessions, least loaded first."""
        load = dict.fromkeys(self.services, 0)
        for session in self.sessions.values():
            for instance in (session.recognizer, session.synthesizer):
                if instance in load:
                    load[instance] += 1
        return sorted(
            (
                instance
                for instance, record in self.services.items()
                if record.heartbeat.service == service and record.heartbeat.state == "ready"
            ),
            key=lambda instance: (load[instance], instance),
        )

    def open(self, opening: OpenSession, client: bytes, now_s: float) -> SessionRecord:
        """Place a new session.

        Raises
        ------
        Refusal
            The name is taken, there are too many sessions, or a service is missing.
        """
        name = opening.session or f"s{secrets.token_hex(4)}"
        if name in self.sessions:
            raise Refusal("session-exists", f"session {name!r} is open; choose another name")
        if len(self.sessions) >= self._max_sessions:
            raise Refusal("too-many-sessions", f"{self._max_sessions} sessions are open already")
        chosen = {service: self._choose(service) for service in REQUIRED}
        record = SessionRecord(
            name=name,
            token=secrets.token_urlsafe(24),
            opening=opening,
            client=client,
            opened_s=now_s,
            started_s=now_s,
            recognizer=chosen["recognizer"],
            synthesizer=chosen["synthesizer"],
            audio=self.services[chosen["recognizer"]].heartbeat.endpoints["audio"],
        )
        record.waiting_for = set(self.participants(record))
        self.sessions[name] = record
        return record

    def participants(self, record: SessionRecord) -> list[str]:
        """Return the instances that take part in a session: those placed and all observers."""
        observers = [
            instance
            for instance, service in self.services.items()
            if service.heartbeat.service in OBSERVERS
        ]
        placed = [i for i in (record.recognizer, record.synthesizer) if i in self.services]
        return placed + observers

    def serves(self, record: SessionRecord, service: str) -> bool:
        """Return whether the session's recognizer or synthesizer is alive."""
        return getattr(record, service) in self.services

    def takes_part(self, heartbeat: Heartbeat, record: SessionRecord) -> bool:
        """Return whether a service is one that serves or observes the session."""
        return heartbeat.service in OBSERVERS or heartbeat.instance in (
            record.recognizer,
            record.synthesizer,
        )

    def owned(self, session: str, token: str) -> SessionRecord:
        """Return a session whose token is given.

        Raises
        ------
        Refusal
            There is no such session, or the token is another's.
        """
        record = self.sessions.get(session)
        if record is None:
            raise Refusal("unknown-session", f"there is no session {session!r}; open it first")
        if not secrets.compare_digest(record.token.encode(), token.encode()):
            raise Refusal("bad-token", f"the token is not that of session {session!r}")
        return record

    def replace(self, record: SessionRecord, now_s: float) -> bool:
        """Place a session again whose recognizer or synthesizer is gone; return success.

        The client keeps sending to the endpoint it was given, so only a recognizer there will do.
        """
        try:
            for service in REQUIRED:
                if not self.serves(record, service):
                    setattr(record, service, self._choose(service, record))
        except Refusal:
            return False
        record.epoch += 1
        record.started_s = now_s
        record.waiting_for = set(self.participants(record))
        return True

    def opened(self, record: SessionRecord, events: str) -> SessionOpened:
        """Return the answer for the client."""
        recognizer = self.services[record.recognizer].heartbeat.endpoints
        synthesizer = self.services[record.synthesizer].heartbeat.endpoints
        return SessionOpened(
            session=record.name,
            request=record.opening.request,
            token=record.token,
            audio=recognizer["audio"],
            phones=recognizer["phones"],
            faps=synthesizer["faps"],
            events=events,
        )

    def age_s(self, record: SessionRecord) -> float:
        """Return for how long a session has been open."""
        return time.monotonic() - record.opened_s

    def _choose(self, service: str, moved: SessionRecord | None = None) -> str:
        instances = self.ready(service)
        if moved is not None and service == "recognizer":
            instances = [
                instance
                for instance in instances
                if self.services[instance].heartbeat.endpoints["audio"] == moved.audio
            ]
        if not instances:
            raise Refusal(
                "no-service",
                f"no {service} is running; start one with 'kouxing {service}' "
                "(or everything with 'kouxing run')",
            )
        return instances[0]
