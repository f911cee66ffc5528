"""Reports the state of services and sessions, in pages."""

from collections.abc import Iterator

from kouxing_client.messages import ServiceState, SessionState

from kouxing.services.control.service_registry import ServiceRecord, ServiceRegistry
from kouxing.services.control.session_record import SessionRecord
from kouxing.services.control.session_table import SessionTable
from kouxing.shared.wire.codec import encoded_size
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import StatusReport, StatusRequest

PAGE_BYTES = 512 * 1024  # so that the largest state still fits into the message
FIRST_SESSION = 2**32  # number of the first session; services have smaller numbers


class StatusReporter:
    """Builds status reports."""

    def __init__(self, registry: ServiceRegistry, sessions: SessionTable) -> None:
        self._registry = registry
        self._sessions = sessions

    def report(
        self, message: StatusRequest, now_s: float, *, resting_face: FaceSettings, shows_token: bool
    ) -> StatusReport:
        """Return one page, or the state of one session and its services.

        The address of the web page contains its token only if ``shows_token``: with the token,
        anyone can open sessions. Raises ``Rejected`` if there is no such session.
        """
        services: list[ServiceState] = []
        sessions: list[SessionState] = []
        next_number = None
        num_bytes = 0
        for number, record in self._records(message):
            state: ServiceState | SessionState
            if isinstance(record, SessionRecord):
                state = record.state(now_s)
                sessions.append(state)
            else:
                state = self._service_state(record, now_s, shows_token=shows_token)
                services.append(state)
            num_bytes += encoded_size(state)
            if num_bytes > PAGE_BYTES and not message.session:
                next_number = number + 1
                break
        return StatusReport(
            request=message.request,
            services=services,
            sessions=sessions,
            next=next_number,
            resting_face=resting_face,
        )

    def _records(
        self, message: StatusRequest
    ) -> Iterator[tuple[int, ServiceRecord | SessionRecord]]:
        """Yield numbered records, from the first one of the page."""
        if message.session:
            session = self._sessions.find(message.session)
            for instance in self._sessions.participants(session):
                yield 0, self._registry[instance]
            yield 0, session
            return
        first = message.after
        if first < FIRST_SESSION:
            yield from enumerate(self._registry.interleaved_by_kind()[first:], first)
        for session in self._sessions.sessions_from(first - FIRST_SESSION):
            yield FIRST_SESSION + session.number, session

    def _service_state(
        self, record: ServiceRecord, now_s: float, *, shows_token: bool
    ) -> ServiceState:
        heartbeat = record.heartbeat
        endpoints = heartbeat.endpoints
        if not shows_token:  # a '#' in other endpoints belongs to their key
            endpoints = {
                name: address.partition("#")[0] if address.startswith("http") else address
                for name, address in endpoints.items()
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
            build=heartbeat.build,
        )
