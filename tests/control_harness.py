"""Control with two services that start every session at once."""

from collections.abc import Callable

import zmq
from kouxing_client.keys import Key
from kouxing_client.messages import Message

from kouxing.evaluation.system.attackers import connect
from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.sockets import Socket
from kouxing.shared.settings.endpoints import key_of, with_key
from kouxing.shared.settings.keys import load_key
from kouxing.shared.wire.codec import decode, encode
from kouxing.shared.wire.control import Heartbeat, SessionStarted, StartSession
from kouxing.shared.wire.session import Error, OpenSession
from tests.system import wait_until

LOCAL = "tcp://127.0.0.1:*"
IDLE_LIMIT_S = 90.0
ENDPOINTS_BY_SERVICE = {"recognizer": ("audio", "phones"), "synthesizer": ("phone_input", "faps")}


def make_heartbeat(kind: str, address: str = "tcp://127.0.0.1:1", **fields: object) -> Heartbeat:
    """Return the heartbeat of a service whose sockets all have one address."""
    defaults = Heartbeat(
        service=kind, instance=kind, role="worker", state="ready", sent_ns=0,
        endpoints=dict.fromkeys(ENDPOINTS_BY_SERVICE[kind], address),
    )  # fmt: skip
    return replace(defaults, **fields)


class ControlHarness:
    """Control and two services that start every session."""

    def __init__(self, *, insecure: bool) -> None:
        self.control = ControlService(
            ControlConfig(
                control=LOCAL,
                events=LOCAL,
                insecure=insecure,
                lost_after_s=60.0,
                idle_limit_s=IDLE_LIMIT_S,
                max_load=1000.0,
            )
        )
        self.refusal: Error | None = None  # of the services, instead of starting a session
        self.buses = []
        self.services = []
        for kind in ENDPOINTS_BY_SERVICE:
            bus = Bus(None if insecure else load_key(kind, (f"service:{kind}",)))
            service = bus.connect_dealer(self.control.endpoints["commands"])
            service.send(make_heartbeat(kind))
            self.buses.append(bus)
            self.services.append(service)
        self.clients: list[zmq.Socket[bytes]] = []
        self.sockets = zmq.Context()
        while not all(service.wait(0.0) for service in self.services):  # they are registered
            self.control.step(0.01)

    def close(self) -> None:
        for raw in self.clients:
            raw.close(linger=0)
        self.sockets.term()
        for bus in (*self.buses, self.control.bus):
            bus.close()

    def connect_client(self, key: Key | None, address: str = "") -> zmq.Socket[bytes]:
        """Return a socket with the same routing id each time; ``address`` may be a forwarder."""
        raw = self.sockets.socket(zmq.DEALER)
        self.clients.append(raw)
        raw.setsockopt(zmq.ROUTING_ID, b"the same")
        endpoint = self.control.endpoints["commands"]
        if address:
            endpoint = with_key(address, key_of(endpoint))
        raw.connect(endpoint) if key is None else connect(raw, endpoint, key)
        return raw

    def open(self, raw: zmq.Socket[bytes], session: str, request: str = "1") -> Message:
        """Open a session; return the answer."""
        raw.send_multipart(encode(OpenSession(request=request, session=session)))
        self.step_until(lambda: bool(raw.poll(0)))
        answer = decode(raw.recv_multipart())
        assert isinstance(answer, Message)
        return answer

    def step_until(self, condition: Callable[[], object]) -> None:
        """Run control and the services until a condition holds."""

        def step() -> None:
            self.control.step(0.01)
            for service in self.services:
                self._start(service)

        wait_until(condition, step=step)

    def receive(self, socket: Socket, num: int = 1) -> list[Message]:
        """Run control until a number of messages have arrived at a socket; return them."""
        received: list[Message] = []

        def step() -> None:
            self.control.step(0.01)
            received.extend(item.message for item in socket.receive())  # type: ignore[misc]

        wait_until(lambda: len(received) >= num, step=step)
        return received

    def _start(self, service: Socket) -> None:
        for received in service.receive():
            if not isinstance(start := received.message, StartSession):
                continue
            if self.refusal is not None:
                refusal = replace(self.refusal, session=start.session, request=start.request)
                service.send(refusal)
            else:
                service.send(SessionStarted(session=start.session, request=start.request))
