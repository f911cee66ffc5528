"""Chooses workers for a session."""

from collections import deque
from collections.abc import Collection, Mapping

from kouxing.services.control.service_registry import ServiceRecord, ServiceRegistry
from kouxing.services.control.worker_load import EQUAL_LOAD, RETRY_AFTER_S
from kouxing.services.service_kinds import PROVIDERS
from kouxing.shared.errors import Rejected
from kouxing.shared.wire.session import ErrorCode

CLIENT_NEEDS = ("audio", "phones", "faps")  # endpoints that a client needs
UNPACED_AUDIO = "unpaced_audio"  # replaces "audio" for sessions that are not paced


class Placement:
    """Places sessions on the workers with the least load."""

    def __init__(self, registry: ServiceRegistry, max_load: float) -> None:
        self._registry = registry
        self._max_load = max_load  # fraction of a worker's time for sessions

    def place(
        self,
        kept: Mapping[str, str],
        now_s: float,
        language: str | None = None,
        *,
        min_room: int = 0,
        excluded: Collection[str] = (),
    ) -> dict[str, str]:
        """Return a worker for each endpoint that a client or a chosen worker needs.

        A worker that is chosen for one endpoint also serves its other endpoints. Workers in
        ``kept`` stay, and those in ``excluded`` are not chosen. If ``language`` is set, the workers
        must have this language. A moved session needs no room.

        Raises ``Rejected`` if no ready worker provides an endpoint, or no worker has room
        for ``min_room`` sessions.
        """
        workers: dict[str, str] = {}
        needed = deque(CLIENT_NEEDS)
        while needed:
            endpoint = needed.popleft()
            if endpoint in workers:
                continue
            placed = {*kept.values(), *workers.values()}
            instance = kept.get(endpoint) or self._choose(
                endpoint, placed, now_s, language, min_room=min_room, excluded=excluded
            )
            workers[endpoint] = instance
            needed += self._registry[instance].heartbeat.needs
        if UNPACED_AUDIO in self._registry[workers["audio"]].heartbeat.endpoints:
            workers[UNPACED_AUDIO] = workers["audio"]
        return workers

    def missing_kinds(self) -> list[str]:
        """Return the kinds of worker that every session needs but that are not running."""
        missing = {
            PROVIDERS[endpoint]
            for endpoint in CLIENT_NEEDS
            if not any(
                _can_serve(record, language=None)
                for record in self._registry.providers(endpoint).values()
            )
        }
        return sorted(missing)

    def _choose(
        self,
        endpoint: str,
        placed: Collection[str],
        now_s: float,
        language: str | None,
        *,
        min_room: int,
        excluded: Collection[str],
    ) -> str:
        providers = {
            name: record
            for name, record in self._registry.providers(endpoint).items()
            if name not in excluded
        }
        names = [name for name, record in providers.items() if _can_serve(record, language)]
        for instance in sorted(placed):
            if instance in names:
                return instance
        if not names:
            raise _no_worker(endpoint, language if providers else None)
        best = min(names, key=lambda name: self._rank(name, now_s))
        load = self._registry.load(best)
        if not load.has_room(min_room, now_s, self._max_load):
            kind = PROVIDERS.get(endpoint, f"provider of {endpoint}")
            required = 100 * min_room * load.cost
            left = 100 * max(0.0, self._max_load - load.expected(now_s))
            text = (
                f"every {kind} is busy: a session needs {required:.0f} % of one, "
                f"but at most {left:.0f} % is free; try again in {RETRY_AFTER_S:g} s"
            )
            raise Rejected(ErrorCode.BUSY, text, RETRY_AFTER_S)
        return best

    def _rank(self, instance: str, now_s: float) -> tuple[int, int, str]:
        load = self._registry.load(instance)
        return round(load.expected(now_s) / EQUAL_LOAD), load.num_sessions, instance


def _no_worker(endpoint: str, language: str | None) -> Rejected:
    """Return the rejection for an endpoint that no worker provides.

    ``language`` is set if there are workers for the endpoint, but none has this language.
    """
    kind = PROVIDERS.get(endpoint)
    if language is not None:
        text = f"no {kind} has the language {language}; choose another one"
        return Rejected(ErrorCode.BAD_LANGUAGE, text)
    missing = f"no {kind} is running" if kind else f"no service provides {endpoint!r}"
    start = f"start one with 'kouxing {kind}'" if kind else "start one that does"
    text = f"{missing}; {start} (or everything with 'kouxing run')"
    return Rejected(ErrorCode.NO_SERVICE, text)


def _can_serve(record: ServiceRecord, language: str | None) -> bool:
    stated, others = record.heartbeat.facts.language, record.heartbeat.languages
    has_language = language is None or stated in (None, language) or language in others
    return record.state == "ready" and has_language
