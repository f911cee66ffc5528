"""Which services are alive, what they provide, and which of them may serve a session.

A worker provides endpoints and needs others, an observer takes part in every session. Control knows
no kinds of service but those that must provide what it knows by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from shared.keys import Peer
from shared.wire.control import Heartbeat
from shared.wire.session import ErrorCode

CLIENT_NEEDS = ("audio", "phones", "faps")  # the endpoints that a client is told
# Who alone may provide an endpoint, as another one's key is for another kind of service.
PROVIDERS = {
    "audio": "recognizer",
    "phones": "recognizer",
    "phone_input": "synthesizer",
    "faps": "synthesizer",
}
MAX_SERVICES = 60  # a status report of the largest states is within the size of a message
MAX_SERVICES_OF_KEY = 30


class Refusal(Exception):
    """A request that control cannot meet."""

    def __init__(self, code: ErrorCode, text: str) -> None:
        super().__init__(text)
        self.code = code
        self.text = text


@dataclass(frozen=True, slots=True)
class ServiceRecord:
    """One running service."""

    peer: Peer  # on control's socket; nobody for control itself
    heartbeat: Heartbeat  # the newest
    received_s: float  # when it came


class Registry:
    """The services by instance."""

    def __init__(self, lost_after_s: float) -> None:
        self._services: dict[str, ServiceRecord] = {}
        self._lost_after_s = lost_after_s

    def __contains__(self, instance: str) -> bool:
        return instance in self._services

    def __getitem__(self, instance: str) -> ServiceRecord:
        return self._services[instance]

    def sorted(self) -> list[tuple[str, ServiceRecord]]:
        """Return all services in the order of their names."""
        return sorted(self._services.items())

    def check(self, heartbeat: Heartbeat, peer: Peer) -> None:
        """Check that a heartbeat may be that of a service.

        Raises
        ------
        Refusal
            The instance is another key's, or there are too many services.
        """
        known = self._services.get(heartbeat.instance)
        if known is None:
            keys = [record.peer.key for record in self._services.values()]
            if len(keys) >= MAX_SERVICES or keys.count(peer.key) >= MAX_SERVICES_OF_KEY:
                raise Refusal(ErrorCode.TOO_MANY_SERVICES, "there are too many services")
        elif known.peer.key != peer.key:
            raise Refusal(ErrorCode.NOT_ALLOWED, f"{heartbeat.instance} runs with another key")

    def add(self, heartbeat: Heartbeat, peer: Peer, now_s: float) -> None:
        """Add a service, or note its newest heartbeat."""
        self._services[heartbeat.instance] = ServiceRecord(peer, heartbeat, now_s)

    def instance_of(self, peer: Peer) -> str:
        """Return the service that a message comes from; empty if its sender is none."""
        return next((name for name, each in self._services.items() if each.peer == peer), "")

    def remove(self, instance: str) -> None:
        """Forget a service."""
        self._services.pop(instance, None)

    def differs(self, heartbeat: Heartbeat) -> bool:
        """Return whether a known instance provides or needs something else than before."""
        known = self._services.get(heartbeat.instance)
        return known is not None and any(
            getattr(known.heartbeat, name) != getattr(heartbeat, name)
            for name in ("role", "endpoints", "needs")
        )

    def displaced_by(self, heartbeat: Heartbeat) -> list[str]:
        """Return the workers whose endpoints a new one provides: they have crashed."""
        return [
            instance
            for instance, record in self._services.items()
            if heartbeat.role == record.heartbeat.role == "worker"
            and instance != heartbeat.instance
            and record.heartbeat.endpoints == heartbeat.endpoints
        ]

    def excuse(self, pause_s: float) -> None:
        """Note that control itself did not listen for some time."""
        for instance, record in self._services.items():
            self._services[instance] = replace(record, received_s=record.received_s + pause_s)

    def silent(self, now_s: float) -> list[str]:
        """Return the services whose last heartbeat is too old."""
        return [
            instance
            for instance, record in self._services.items()
            if record.peer.address and now_s - record.received_s > self._lost_after_s
        ]

    def observers(self) -> set[str]:
        """Return the services that take part in every session."""
        return {
            instance
            for instance, record in self._services.items()
            if record.heartbeat.role == "observer"
        }

    def place(
        self, kept: Mapping[str, str], load: Mapping[str, int], language: str = ""
    ) -> dict[str, str]:
        """Choose a worker for every endpoint that a client needs, or that a chosen worker needs.

        A worker that is chosen for one endpoint also serves the others it provides; otherwise the
        least loaded ready worker is chosen.

        Parameters
        ----------
        kept
            Instance by endpoint: workers that stay.
        load
            Number of sessions by instance.
        language
            Of a session that is placed again: no worker of another language will do.

        Returns
        -------
        dict
            Instance by endpoint.

        Raises
        ------
        Refusal
            No ready worker provides one of the endpoints.
        """
        workers: dict[str, str] = {}
        wanted = list(CLIENT_NEEDS)
        for endpoint in wanted:  # grows
            instance = kept.get(endpoint) or self._choose(
                endpoint, {*kept.values(), *workers.values()}, load, language
            )
            workers[endpoint] = instance
            needs = self._services[instance].heartbeat.needs
            wanted += [need for need in needs if need not in wanted]
        return workers

    def endpoints(self, workers: Mapping[str, str]) -> dict[str, str]:
        """Return the address of each endpoint in a placement."""
        return {
            endpoint: self._services[instance].heartbeat.endpoints[endpoint]
            for endpoint, instance in workers.items()
        }

    def language(self, instances: Iterable[str]) -> str:
        """Return the language that one of these services recognises; empty if none does."""
        languages = (self._services[instance].heartbeat.language for instance in instances)
        return next(filter(None, languages), "")

    def frame_rate_hz(self, instances: Iterable[str]) -> float:
        """Return the rate of the FAP frames that one of these services makes; 0 if none does."""
        rates = (self._services[instance].heartbeat.frame_rate_hz for instance in instances)
        return next(filter(None, rates), 0.0)

    def delay_ms(self, instances: Iterable[str]) -> float:
        """Return how much later than its sound one of these services makes a FAP frame."""
        delays = (self._services[instance].heartbeat.delay_ms for instance in instances)
        return next(filter(None, delays), 0.0)

    def lips(self, instances: Iterable[str]) -> str:
        """Return the lip model that one of these services uses at first; empty if none does."""
        models = (self._services[instance].heartbeat.lips for instance in instances)
        return next(filter(None, models), "")

    def _choose(
        self, endpoint: str, placed: set[str], load: Mapping[str, int], language: str
    ) -> str:
        providers = [
            instance
            for instance, record in self._services.items()
            if record.heartbeat.role == "worker"
            and endpoint in record.heartbeat.endpoints
            and record.heartbeat.state == "ready"
            and (not language or record.heartbeat.language in ("", language))
        ]
        if not providers:
            kind = PROVIDERS.get(endpoint)
            start = f"start one with 'kouxing {kind}'" if kind else "start one that does"
            missing = f"no {kind} is running" if kind else f"no service provides {endpoint!r}"
            raise Refusal(
                ErrorCode.NO_SERVICE, f"{missing}; {start} (or everything with 'kouxing run')"
            )
        return min(providers, key=lambda name: (name not in placed, load.get(name, 0), name))
