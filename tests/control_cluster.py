"""The state of control with some workers; no sockets, no clocks."""

from typing import Any

from kouxing_client.messages import SessionFacts

from kouxing.services.control.placement import Placement
from kouxing.services.control.service_registry import ServiceRegistry
from kouxing.services.control.session_record import SessionRecord
from kouxing.services.control.session_table import SessionTable
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.control import Heartbeat, SessionProgress
from kouxing.shared.wire.session import OpenSession

CLIENT = Peer(b"client", "its key")
PROVIDES = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}
NEEDS = {"recognizer": ["phone_input"], "synthesizer": []}
FACTS = {
    "recognizer": SessionFacts(language="mandarin"),
    "synthesizer": SessionFacts(frame_rate_hz=50.0, delay_ms=100.0, lip_model="dynamic-visemes"),
}


def worker(service: str, instance: str, state: str = "ready") -> Heartbeat:
    return Heartbeat(
        service=service,
        instance=instance,
        role="worker",
        state=state,
        sent_ns=0,
        endpoints={name: f"tcp://{instance}:{name}" for name in PROVIDES[service]},
        needs=NEEDS[service],
        facts=FACTS[service],
        sessions={"mine": SessionProgress()},
    )


class Cluster:
    """The state of a control with one recognizer and one synthesizer."""

    def __init__(self, max_sessions: int = 8, max_load: float = 1000.0) -> None:
        self.registry = ServiceRegistry(lost_after_s=3.0)
        self.placement = Placement(self.registry, max_load)
        self.sessions = SessionTable(self.registry, self.placement, max_sessions)
        for service in PROVIDES:
            self.add(worker(service, f"{service}-1"))

    def add(self, heartbeat: Heartbeat, now_s: float = 0.0) -> None:
        self.registry.add(heartbeat, Peer(heartbeat.instance.encode()), now_s)

    def lose(self, instance: str) -> None:
        self.registry.remove(instance)
        self.sessions.mark_worker_lost(instance, 1.0)

    def open(self, name: str = "", client: Peer = CLIENT, **fields: object) -> SessionRecord:
        opening = OpenSession(session=name, request="r", **fields)  # type: ignore[arg-type]
        return self.sessions.open(opening, client, 0.0)

    def report(self, record: SessionRecord, instance: str, **fields: Any) -> None:
        """Record a heartbeat about a session that its client uses."""
        record.is_announced = True
        heartbeat = worker(instance.partition("-")[0], instance)
        sessions = {record.name: SessionProgress(**fields)}
        self.sessions.record_progress(record, replace(heartbeat, sessions=sessions))
