"""Keeps the running services and the endpoints that they provide.

A worker provides endpoints and needs others. An observer takes part in every session.
"""

import math
from collections import Counter, OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from operator import itemgetter

from kouxing_client.messages import SessionFacts

from kouxing.services.control.worker_load import WorkerLoad
from kouxing.services.service_kinds import PROVIDERS
from kouxing.shared.errors import Rejected, UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.service.base import HEARTBEAT_S, IDLE_HEARTBEAT_S
from kouxing.shared.settings.endpoints import split_endpoint, with_key
from kouxing.shared.wire.control import Heartbeat
from kouxing.shared.wire.session import ErrorCode

MAX_SERVICES = 2000
MAX_SERVICES_PER_KEY = 1500
MAX_REMEMBERED = 1000  # limit of lost services that are recognized when they return
MAX_LATE_S = 5.0  # a service that returns within this time was late, not lost
TIMEOUT_RESET_S = 60.0  # after this time without a late service, the usual timeout applies again


@dataclass(slots=True)
class ServiceRecord:
    """One running service."""

    peer: Peer  # on control's socket; NO_PEER for control itself
    heartbeat: Heartbeat  # first heartbeat, with keys in its endpoints and without sessions
    bare_endpoints: Mapping[str, str]  # without keys
    heartbeat_s: float = 0.0  # when the newest heartbeat arrived
    state: str = "ready"
    metrics: Mapping[str, float] = field(default_factory=dict)


class ServiceRegistry:
    """The running services, by instance.

    No heartbeat or tick iterates over all services: they are ordered by their newest heartbeat, and
    every lookup has an index.
    """

    def __init__(self, lost_after_s: float) -> None:
        self._services: dict[str, ServiceRecord] = {}
        # services except control, oldest heartbeat first: workers with sessions, and others
        self._busy: OrderedDict[str, ServiceRecord] = OrderedDict()
        self._idle: OrderedDict[str, ServiceRecord] = OrderedDict()
        self._usual_timeout_s = self._timeout_s = lost_after_s
        self._last_late_s = -math.inf
        self._paused_s = 0.0  # total time in which control itself did not run
        self._observers: set[str] = set()
        self._by_peer: dict[Peer, str] = {}
        self._by_connection: dict[int, str] = {}
        self._by_endpoint: dict[tuple[str, str], str] = {}  # by name and address
        self._providers: dict[str, dict[str, ServiceRecord]] = {}  # workers by endpoint
        self._num_per_key: Counter[str] = Counter()
        self._loads: dict[str, WorkerLoad] = {}  # loads of workers that run or have sessions
        self._lost: OrderedDict[str, Peer] = OrderedDict()  # by time

    def __len__(self) -> int:
        return len(self._services)

    def __contains__(self, instance: str) -> bool:
        return instance in self._services

    def __getitem__(self, instance: str) -> ServiceRecord:
        return self._services[instance]

    def interleaved_by_kind(self) -> list[ServiceRecord]:
        """Return all services: one of each kind, then the second of each kind, and so on."""
        counts: Counter[str] = Counter()
        ranked = []
        for instance, record in sorted(self._services.items()):
            kind = record.heartbeat.service
            counts[kind] += 1
            ranked.append(((counts[kind], instance), record))
        return [record for _, record in sorted(ranked, key=itemgetter(0))]

    # --- services come and go ------------------------------------------------------------------

    def check(self, heartbeat: Heartbeat, peer: Peer) -> None:
        """Check that a heartbeat may register its service, or is from the registered service.

        Raises ``Rejected`` if the instance belongs to another key, an endpoint is malformed
        or belongs to another kind of service, or there are too many services.
        """
        record = self._services.get(heartbeat.instance)
        if record is None or self.is_other_process(heartbeat, peer):
            _check_endpoints(heartbeat)
        if record is None:
            is_full = len(self._services) >= MAX_SERVICES
            if is_full or self._num_per_key[peer.key] >= MAX_SERVICES_PER_KEY:
                raise Rejected(
                    ErrorCode.TOO_MANY_SERVICES, "too many services are registered; stop some"
                )
        elif record.peer.key != peer.key:
            text = f"{heartbeat.instance} is registered with another key"
            raise Rejected(ErrorCode.NOT_ALLOWED, text)

    def add(self, heartbeat: Heartbeat, peer: Peer, now_s: float, num_speaking: int = 0) -> None:
        """Register a service, or record its newest heartbeat.

        ``num_speaking`` is the number of the service's speaking sessions.
        """
        instance = heartbeat.instance
        record = self._services.get(instance)
        if record is None:
            record = self._services[instance] = self._register(heartbeat, peer)
        elif not peer.connection:  # the message was read after its connection had ended
            peer = record.peer
        elif record.peer.connection != peer.connection:
            self._by_connection.pop(record.peer.connection, None)
        if peer.connection:
            self._by_connection[peer.connection] = instance
        record.peer, record.heartbeat_s = peer, now_s - self._paused_s
        record.state, record.metrics = heartbeat.state, heartbeat.metrics
        self._busy.pop(instance, None)
        self._idle.pop(instance, None)
        if record.peer != NO_PEER:  # NO_PEER is control itself
            is_busy = heartbeat.role == "worker" and heartbeat.sessions
            (self._busy if is_busy else self._idle)[instance] = record
        if heartbeat.role == "worker":
            self.load(instance).measure(heartbeat.load, now_s, num_speaking)

    def _register(self, heartbeat: Heartbeat, peer: Peer) -> ServiceRecord:
        instance = heartbeat.instance
        first = replace(heartbeat, endpoints=_with_keys(heartbeat, peer), sessions={})
        record = ServiceRecord(peer, first, heartbeat.endpoints)
        self._num_per_key[peer.key] += 1
        if peer != NO_PEER:
            self._by_peer[peer] = instance
        if first.role == "observer":
            self._observers.add(instance)
        elif first.role == "worker":
            self._by_endpoint.update(dict.fromkeys(first.endpoints.items(), instance))
            for endpoint in first.endpoints:
                self._providers.setdefault(endpoint, {})[instance] = record
        return record

    def remove(self, instance: str) -> None:
        """Remove a service; remember its process, in case it was declared lost by mistake."""
        record = self._services.pop(instance, None)
        if record is None:
            return
        self._busy.pop(instance, None)
        self._idle.pop(instance, None)
        self._num_per_key[record.peer.key] -= 1
        self._observers.discard(instance)
        if self._by_peer.get(record.peer) == instance:
            del self._by_peer[record.peer]
        if self._by_connection.get(record.peer.connection) == instance:
            del self._by_connection[record.peer.connection]
        for name, address in record.heartbeat.endpoints.items():
            if self._by_endpoint.get((name, address)) == instance:
                del self._by_endpoint[name, address]
            self._providers.get(name, {}).pop(instance, None)
        self._lost[instance] = record.peer
        self._lost.move_to_end(instance)
        if len(self._lost) > MAX_REMEMBERED:
            self._lost.popitem(last=False)
        if not self.load(instance).num_sessions:
            self.forget_load(instance)

    def is_stale(self, instance: str, peer: Peer) -> bool:
        """Return whether a heartbeat is from an ended connection of a lost service."""
        lost = self._lost.get(instance, NO_PEER)
        return lost.connection > 0 and peer.connection == 0

    def is_other_process(self, heartbeat: Heartbeat, peer: Peer) -> bool:
        """Return whether a known instance is now another process."""
        record = self._services.get(heartbeat.instance)
        return record is not None and (
            record.peer != peer
            or record.bare_endpoints != heartbeat.endpoints
            or record.heartbeat.role != heartbeat.role
            or record.heartbeat.needs != heartbeat.needs
        )

    def reclaim_lost(self, instance: str, peer: Peer) -> bool:
        """Return whether a new registration is from a process that was declared lost."""
        return self._lost.pop(instance, NO_PEER) == peer

    def find_replaced_worker(self, heartbeat: Heartbeat, peer: Peer) -> str | None:
        """Return the crashed worker, if any, that had the same endpoints as a new worker."""
        if heartbeat.role != "worker":
            return None
        endpoints = _with_keys(heartbeat, peer)
        for item in endpoints.items():
            instance = self.worker_at(*item)
            if instance not in (None, heartbeat.instance):
                record = self._services[instance]
                if record.heartbeat.endpoints == endpoints:
                    return instance
        return None

    # --- lookups -------------------------------------------------------------------------------

    def instance_by_peer(self, peer: Peer) -> str | None:
        """Return the service with this peer identity."""
        return self._by_peer.get(peer)

    def instance_by_connection(self, connection: int) -> str | None:
        """Return the service whose newest heartbeat arrived on a connection."""
        return self._by_connection.get(connection)

    def worker_at(self, endpoint: str, address: str) -> str | None:
        """Return the worker that provides an endpoint at an address."""
        return self._by_endpoint.get((endpoint, address))

    def providers(self, endpoint: str) -> Mapping[str, ServiceRecord]:
        """Return the workers that provide an endpoint, by instance."""
        return self._providers.get(endpoint, {})

    def lip_models(self) -> list[str]:
        """Return the lip models of the running synthesizers, sorted; empty if some are unknown."""
        lists = [record.heartbeat.lip_models for record in self.providers("faps").values()]
        return sorted({name for names in lists for name in names}) if all(lists) else []

    def observers(self) -> set[str]:
        """Return the services that take part in every session."""
        return set(self._observers)

    def has_driver(self) -> bool:
        """Return whether a driver is ready to write videos."""
        records = (self._services[instance] for instance in self._observers)
        return any(r.heartbeat.service == "driver" and r.state == "ready" for r in records)

    def is_observer(self, instance: str) -> bool:
        """Return whether a service takes part in every session."""
        return instance in self._observers

    def endpoints(self, workers: Mapping[str, str]) -> dict[str, str]:
        """Return the address of each endpoint in a placement."""
        return {
            endpoint: self._services[instance].heartbeat.endpoints[endpoint]
            for endpoint, instance in workers.items()
        }

    def facts(self, instances: Iterable[str]) -> SessionFacts:
        """Return the combined facts of services about their sessions."""
        facts = SessionFacts()
        for instance in instances:
            stated = self._services[instance].heartbeat.facts
            unknown = [name for name in facts.__struct_fields__ if getattr(facts, name) is None]
            facts = replace(facts, **{name: getattr(stated, name) for name in unknown})
        return facts

    # --- loads and silence ---------------------------------------------------------------------

    def load(self, instance: str) -> WorkerLoad:
        """Return the load of a worker. A lost worker with sessions also has a load."""
        return self._loads.setdefault(instance, WorkerLoad())

    def forget_load(self, instance: str) -> None:
        """Drop the load of a lost worker without sessions."""
        if instance not in self._services:
            self._loads.pop(instance, None)

    def exclude_pause(self, pause_s: float, now_s: float) -> None:
        """Exclude a pause of control itself, before ``now_s``, from the age of heartbeats."""
        if pause_s <= 0.0:
            return
        self._paused_s += pause_s
        for record in self._services.values():  # a heartbeat may have arrived after the pause
            record.heartbeat_s = min(record.heartbeat_s, now_s - self._paused_s)

    def adapt_timeout(self, after_s: float, now_s: float) -> None:
        """Increase the heartbeat timeout if a service that was declared lost was only late.

        Otherwise, sessions on a busy machine would move from one late worker to the next.
        """
        if after_s < MAX_LATE_S:
            self._timeout_s = min(2 * self._timeout_s, max(MAX_LATE_S, self._usual_timeout_s))
            self._last_late_s = now_s

    def age_s(self, instance: str, now_s: float) -> float:
        """Return the age of a service's newest heartbeat, without control's own pauses."""
        return now_s - self._paused_s - self._services[instance].heartbeat_s

    def next_overdue_s(self) -> float:
        """Return the time at which the oldest heartbeat becomes too old."""
        oldest = (
            (next(iter(services.values())), max_age_s)
            for services, max_age_s in self._max_ages_s()
            if services
        )
        dues_s = (record.heartbeat_s + max_age_s for record, max_age_s in oldest)
        return self._paused_s + min(dues_s, default=math.inf)

    def overdue_services(self, now_s: float) -> list[str]:
        """Return the services whose newest heartbeat is too old."""
        if now_s > self._last_late_s + TIMEOUT_RESET_S:
            self._timeout_s = self._usual_timeout_s
        overdue = []
        for services, max_age_s in self._max_ages_s():
            for instance in services:
                if self.age_s(instance, now_s) <= max_age_s:
                    break
                overdue.append(instance)
        return overdue

    def _max_ages_s(self) -> Iterable[tuple[Mapping[str, ServiceRecord], float]]:
        """Return services by heartbeat interval, oldest heartbeat first, with their age limit."""
        return (
            (self._busy, self._timeout_s),
            (self._idle, self._timeout_s + IDLE_HEARTBEAT_S - HEARTBEAT_S),
        )


def _with_keys(heartbeat: Heartbeat, peer: Peer) -> dict[str, str]:
    """Return a service's endpoints; endpoints of a worker contain its public key."""
    if heartbeat.role != "worker":
        return heartbeat.endpoints
    return {name: with_key(address, peer.key) for name, address in heartbeat.endpoints.items()}


def _check_endpoints(heartbeat: Heartbeat) -> None:
    """Check that a worker may provide its endpoints, and that clients can connect to them."""
    if heartbeat.role != "worker":
        return
    if not heartbeat.endpoints:
        raise Rejected(ErrorCode.BAD_MESSAGE, "a worker must name the endpoints that it provides")
    for name, endpoint in heartbeat.endpoints.items():
        provider = PROVIDERS.get(name, heartbeat.service)
        if provider != heartbeat.service:
            text = f"only a {provider} may provide {name!r}, and this is a {heartbeat.service}"
            raise Rejected(ErrorCode.NOT_ALLOWED, text)
        try:
            host, port = split_endpoint(endpoint, name)
        except UserError as error:
            raise Rejected(ErrorCode.BAD_MESSAGE, str(error)) from None
        if "*" in (host, port):
            text = f"{name}: {endpoint!r} is not a host and port to connect to"
            raise Rejected(ErrorCode.BAD_MESSAGE, text)
