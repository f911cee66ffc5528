"""Collects the sessions of an earlier control process in the first seconds after startup."""

from collections.abc import Collection

from kouxing_client.messages import Speech

from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.shared.fast_record import replace
from kouxing.shared.wire.control import Heartbeat, StartSession

RECOVERY_S = 5.0


class RestartRecovery:
    """The sessions that services report after a restart of control, until ``end_s``."""

    def __init__(self, registry: ServiceRegistry, now_s: float) -> None:
        self.is_active = True
        self.end_s = now_s + RECOVERY_S
        self._registry = registry
        self._reported: dict[str, StartSession] = {}  # sessions that are not restored yet
        self._sessions_by_observer: dict[str, Collection[str]] = {}

    def add_reported_session(self, start: StartSession, instance: str) -> bool:
        """Add a session that a service reports; return False if the service may not report it."""
        if not self.is_active or not self._is_recognizer(start, instance):
            return False
        known = self._reported.get(start.session)
        if known is not None and known.epoch > start.epoch:
            return False  # the session has moved away from this recognizer, which was stalled
        self._reported[start.session] = start
        return True

    def record_speech(self, speech: Speech, instance: str) -> None:
        """Record that speech starts or stops in a session that is not restored yet."""
        start = self._reported.get(speech.session)
        if start is not None and self._is_recognizer(start, instance):
            speech_time = speech.media_time if speech.active else None
            self._reported[speech.session] = replace(start, speech_time=speech_time)

    def _is_recognizer(self, start: StartSession, instance: str) -> bool:
        audio = self._registry[instance].heartbeat.endpoints.get("audio")
        return audio is not None and start.endpoints.get("audio") == audio

    def record_observer(self, heartbeat: Heartbeat) -> None:
        """Record the sessions that an observer already takes part in."""
        if self.is_active and heartbeat.role == "observer":
            self._sessions_by_observer[heartbeat.instance] = heartbeat.sessions.keys()

    def pop_complete(self) -> list[StartSession]:
        """Remove and return the sessions whose workers are all back; at the end, all sessions."""
        complete = [
            start
            for start in self._reported.values()
            if not self.is_active
            or all(self._registry.worker_at(*item) for item in start.endpoints.items())
        ]
        for start in complete:
            del self._reported[start.session]
        return complete

    def observers_that_missed_start(self, session: str) -> set[str]:
        """Return the observers that do not take part in a session yet."""
        return {
            instance
            for instance in self._registry.observers()
            if session not in self._sessions_by_observer.get(instance, ())
        }
