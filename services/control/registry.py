"""Which services are alive, what they provide, and which of them may serve a session.

A worker provides endpoints and needs others, an observer takes part in every session. Control knows
no kinds of service but those that must provide what it knows by name.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from operator import itemgetter

from kouxing.services.control.load import RETRY_AFTER_S, SAME_LOAD, WorkerLoad
from kouxing.services.kinds import PROVIDERS
from kouxing.shared.endpoints import with_key
from kouxing.shared.keys import NO_PEER, Peer
from kouxing.shared.wire.control import Heartbeat
from kouxing.shared.wire.session import ErrorCode, SessionFacts

CLIENT_NEEDS = ("audio", "phones", "faps")  # the endpoints that a client is told
UNPACED_AUDIO = "unpaced_audio"  # instead of "audio", where a recognizer has it
MAX_SERVICES = 2000
MAX_SERVICES_OF_KEY = 1500
MAX_CANDIDATES = 32  # workers of which the least loaded gets a session
MAX_REMEMBERED = 1000  # lost services that are known again when they come back


class Refusal(Exception):
    """A request that control cannot meet."""

    def __init__(self, code: ErrorCode, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(text)
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s


@dataclass(slots=True)
class ServiceRecord:
    """One running service."""

    peer: Peer  # on control's socket; nobody for control itself
    heartbeat: Heartbeat  # the one that registered it, without sessions
    offered: Mapping[str, str]  # its endpoints without their key
    received_s: float = 0.0  # when the newest came
    state: str = "ready"  # as that said, and its figures
    metrics: Mapping[str, float] = field(default_factory=dict)


class Registry:
    """The services by instance.

    Nothing here walks over all services at every heartbeat or tick: they are in the order of their
    newest heartbeats, and indexed by whatever they are looked up by.
    """

    def __init__(self, lost_after_s: float, max_load: float) -> None:
        self._services: OrderedDict[str, ServiceRecord] = OrderedDict()  # the newest last
        self._lost_after_s = lost_after_s
        self._max_load = max_load  # of a worker
        self._excused_s = 0.0  # that control itself did not listen, in all
        self._observers: set[str] = set()
        self._by_peer: dict[Peer, str] = {}
        self._by_connection: dict[int, str] = {}
        self._by_endpoint: dict[tuple[str, str], str] = {}  # by name and address
        self._providers: dict[str, dict[str, ServiceRecord]] = {}  # workers by endpoint
        self._next_candidate = 0  # among a great many workers
        self._num_of_key: Counter[str] = Counter()
        self._loads: dict[str, WorkerLoad] = {}  # of workers, and of those whose sessions wait
        self._lost: OrderedDict[str, Peer] = OrderedDict()  # the newest last

    def __len__(self) -> int:
        return len(self._services)

    def __contains__(self, instance: str) -> bool:
        return instance in self._services

    def __getitem__(self, instance: str) -> ServiceRecord:
        return self._services[instance]

    def sorted(self) -> list[ServiceRecord]:
        """Return all services by name, but one of each kind first, then the second of each."""
        numbers: Counter[str] = Counter()
        ranked = []
        for instance, record in sorted(self._services.items()):
            kind = record.heartbeat.service
            numbers[kind] += 1
            ranked.append(((numbers[kind], instance), record))
        return [record for _, record in sorted(ranked, key=itemgetter(0))]

    def check(self, heartbeat: Heartbeat, peer: Peer) -> None:
        """Check that a heartbeat may be that of a service.

        Raises
        ------
        Refusal
            The instance is another key's, or there are too many services.
        """
        known = self._services.get(heartbeat.instance)
        if known is None:
            if (
                len(self._services) >= MAX_SERVICES
                or self._num_of_key[peer.key] >= MAX_SERVICES_OF_KEY
            ):
                raise Refusal(ErrorCode.TOO_MANY_SERVICES, "there are too many services")
        elif known.peer.key != peer.key:
            raise Refusal(ErrorCode.NOT_ALLOWED, f"{heartbeat.instance} runs with another key")

    def add(self, heartbeat: Heartbeat, peer: Peer, now_s: float) -> None:
        """Add a service, or note its newest heartbeat."""
        instance = heartbeat.instance
        record = self._services.get(instance)
        if record is None:
            kept = replace(heartbeat, endpoints=_keyed(heartbeat, peer), sessions={})
            record = ServiceRecord(peer, kept, heartbeat.endpoints)
            self._services[instance] = record
            heartbeat = kept
            self._num_of_key[peer.key] += 1
            if peer != NO_PEER:
                self._by_peer[peer] = instance
            if heartbeat.role == "observer":
                self._observers.add(instance)
            elif heartbeat.role == "worker":
                self._by_endpoint.update(dict.fromkeys(heartbeat.endpoints.items(), instance))
                for endpoint in heartbeat.endpoints:
                    self._providers.setdefault(endpoint, {})[instance] = record
        elif record.peer.connection != peer.connection:
            self._by_connection.pop(record.peer.connection, None)
        if peer.connection:
            self._by_connection[peer.connection] = instance
        record.peer, record.received_s = peer, now_s - self._excused_s
        record.state, record.metrics = heartbeat.state, heartbeat.metrics
        self._services.move_to_end(instance)
        if heartbeat.role == "worker":
            self.load(instance).measure(heartbeat.load, now_s)

    def load(self, instance: str) -> WorkerLoad:
        """Return the load of a worker, also of one that is lost and has sessions."""
        return self._loads.setdefault(instance, WorkerLoad())

    def forget_load(self, instance: str) -> None:
        """Forget the load of a worker that has no sessions any more, if it is lost."""
        if instance not in self._services:
            self._loads.pop(instance, None)

    def instance_of(self, peer: Peer) -> str:
        """Return the service that a message comes from; empty if its sender is none."""
        return self._by_peer.get(peer, "")

    def instance_at(self, connection: int) -> str:
        """Return the service whose newest heartbeat came through a connection; empty if none."""
        return self._by_connection.get(connection, "")

    def remove(self, instance: str) -> None:
        """Forget a service, but for its name if the same process comes back."""
        record = self._services.pop(instance, None)
        if record is None:
            return
        self._num_of_key[record.peer.key] -= 1
        self._observers.discard(instance)
        if self._by_peer.get(record.peer) == instance:
            del self._by_peer[record.peer]
        if self._by_connection.get(record.peer.connection) == instance:
            del self._by_connection[record.peer.connection]
        for endpoint in record.heartbeat.endpoints.items():
            if self._by_endpoint.get(endpoint) == instance:
                del self._by_endpoint[endpoint]
            if endpoint[0] in self._providers:
                self._providers[endpoint[0]].pop(instance, None)
        self._lost[instance] = record.peer
        self._lost.move_to_end(instance)
        if len(self._lost) > MAX_REMEMBERED:
            self._lost.popitem(last=False)
        if not self.load(instance).num_sessions:
            self.forget_load(instance)

    def differs(self, heartbeat: Heartbeat, peer: Peer) -> bool:
        """Return whether a known instance is another process than before."""
        known = self._services.get(heartbeat.instance)
        return known is not None and (
            known.peer != peer
            or known.offered != heartbeat.endpoints
            or known.heartbeat.role != heartbeat.role
            or known.heartbeat.needs != heartbeat.needs
        )

    def is_back(self, instance: str, peer: Peer) -> bool:
        """Return whether a new service is a lost one, the same process, and not lost after all."""
        return self._lost.pop(instance, NO_PEER) == peer

    def displaced_by(self, heartbeat: Heartbeat, peer: Peer) -> str:
        """Return the worker whose endpoints a new one provides: it has crashed. Empty if none."""
        if heartbeat.role != "worker":
            return ""
        endpoints = _keyed(heartbeat, peer)
        for instance in {self.provider(*each) for each in endpoints.items()} - {""}:
            if instance != heartbeat.instance and (
                self._services[instance].heartbeat.endpoints == endpoints
            ):
                return instance
        return ""

    def provider(self, endpoint: str, address: str) -> str:
        """Return the worker that provides an endpoint at an address; empty if none does."""
        return self._by_endpoint.get((endpoint, address), "")

    def excuse(self, pause_s: float) -> None:
        """Note that control itself did not listen for some time."""
        self._excused_s += pause_s

    def age_s(self, instance: str, now_s: float) -> float:
        """Return how long ago a service's newest heartbeat came, without control's own pauses."""
        return now_s - self._excused_s - self._services[instance].received_s

    def silent(self, now_s: float) -> list[str]:
        """Return the services whose last heartbeat is too old."""
        return list(self._silent(now_s))

    def _silent(self, now_s: float) -> Iterator[str]:
        for instance, record in self._services.items():
            if self.age_s(instance, now_s) <= self._lost_after_s:
                return
            if record.peer != NO_PEER:
                yield instance

    def is_observer(self, instance: str) -> bool:
        """Return whether a service takes part in every session."""
        return instance in self._observers

    def observers(self) -> set[str]:
        """Return the services that take part in every session."""
        return set(self._observers)

    def place(
        self,
        kept: Mapping[str, str],
        now_s: float,
        language: str | None = None,
        *,
        may_refuse: bool = False,
    ) -> dict[str, str]:
        """Choose a worker for every endpoint that a client needs, or that a chosen worker needs.

        A worker that is chosen for one endpoint also serves the others it provides; otherwise the
        least loaded ready worker is chosen. A new live session needs one that has room for it. One
        that is placed again, or whose sound is faster than real time, is never refused for that.

        Parameters
        ----------
        kept
            Instance by endpoint: workers that stay.
        now_s
            The present.
        language
            Of a session that is placed again: no worker of another language will do.
        may_refuse
            Whether the session may be refused.

        Returns
        -------
        dict
            Instance by endpoint.

        Raises
        ------
        Refusal
            No ready worker provides one of the endpoints, or none has room.
        """
        workers: dict[str, str] = {}
        wanted = list(CLIENT_NEEDS)
        for endpoint in wanted:  # grows
            placed = {*kept.values(), *workers.values()}
            instance = kept.get(endpoint) or self._choose(
                endpoint, placed, now_s, language, may_refuse=may_refuse
            )
            workers[endpoint] = instance
            needs = self._services[instance].heartbeat.needs
            wanted += [need for need in needs if need not in wanted]
        if UNPACED_AUDIO in self._services[workers["audio"]].heartbeat.endpoints:
            workers[UNPACED_AUDIO] = workers["audio"]
        return workers

    def endpoints(self, workers: Mapping[str, str]) -> dict[str, str]:
        """Return the address of each endpoint in a placement."""
        return {
            endpoint: self._services[instance].heartbeat.endpoints[endpoint]
            for endpoint, instance in workers.items()
        }

    def facts(self, instances: Iterable[str]) -> SessionFacts:
        """Return what these services together state about their sessions."""
        stated = [asdict(self._services[instance].heartbeat.facts) for instance in instances]
        return SessionFacts(
            **{
                name: next((facts[name] for facts in stated if facts[name] is not None), None)
                for name in asdict(SessionFacts())
            }
        )

    def _choose(
        self,
        endpoint: str,
        placed: set[str],
        now_s: float,
        language: str | None,
        *,
        may_refuse: bool,
    ) -> str:
        providers = self._providers.get(endpoint, {})
        for instance in sorted(placed & providers.keys()):
            if _may_serve(providers[instance], language):
                return instance
        names = [name for name, each in providers.items() if _may_serve(each, language)]
        if not names:
            kind = PROVIDERS.get(endpoint)
            start = f"start one with 'kouxing {kind}'" if kind else "start one that does"
            missing = f"no {kind} is running" if kind else f"no service provides {endpoint!r}"
            raise Refusal(
                ErrorCode.NO_SERVICE, f"{missing}; {start} (or everything with 'kouxing run')"
            )
        best = min(self._candidates(names), key=lambda name: self._rank(name, now_s))
        if may_refuse and not self._has_room(best, now_s):
            best = min(names, key=lambda name: self._rank(name, now_s))
        if may_refuse and not self._has_room(best, now_s):
            text = (
                f"every {PROVIDERS.get(endpoint, f'provider of {endpoint}')} has as many sessions "
                f"as it can serve in time; try again in {RETRY_AFTER_S:g} s"
            )
            raise Refusal(ErrorCode.BUSY, text, RETRY_AFTER_S)
        return best

    def _has_room(self, instance: str, now_s: float) -> bool:
        return self.load(instance).has_room(now_s, self._max_load)

    def _candidates(self, names: list[str]) -> list[str]:
        """Return some of the workers in turn where they are too many to compare all each time."""
        if len(names) <= MAX_CANDIDATES:
            return names
        begin = self._next_candidate % len(names)
        self._next_candidate = begin + MAX_CANDIDATES
        return names[begin : self._next_candidate]

    def _rank(self, instance: str, now_s: float) -> tuple[int, int, str]:
        """Return by what the least loaded worker is chosen; the load is too noisy for details."""
        load = self.load(instance)
        return round(load.expected(now_s) / SAME_LOAD), load.num_sessions, instance


def _keyed(heartbeat: Heartbeat, peer: Peer) -> dict[str, str]:
    """Return a service's endpoints, those of a worker with the key of whom is bound there."""
    if heartbeat.role != "worker":
        return heartbeat.endpoints
    return {name: with_key(each, peer.key) for name, each in heartbeat.endpoints.items()}


def _may_serve(record: ServiceRecord, language: str | None) -> bool:
    return record.state == "ready" and (
        language is None or record.heartbeat.facts.language in (None, language)
    )
