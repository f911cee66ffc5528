"""Control's configuration."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from kouxing.shared.settings.config import BoundEndpoint, ServiceConfig
from kouxing.shared.settings.endpoints import (
    WILDCARDS,
    is_address,
    is_loopback,
    local_address,
    split_endpoint,
    with_host,
)


@dataclass(frozen=True, kw_only=True)
class ControlConfig(ServiceConfig):
    """The settings of control."""

    control: BoundEndpoint = "tcp://127.0.0.1:5550"
    """Address at which control accepts commands. Control binds it; if it contains a host name,
    control binds all addresses of its host."""
    events: BoundEndpoint = "tcp://127.0.0.1:5551"
    """Address that control binds to publish events."""
    max_sessions: Annotated[int, Meta(ge=1, le=1_000_000)] = 64
    """Maximum number of open sessions. One key can open at most three quarters of them."""
    max_load: Annotated[float, Meta(ge=0.1, le=1000)] = 0.8
    """Control rejects new sessions that would keep a worker busy for more than this fraction of the
    time. The rest is reserved for sessions that move from another worker. 1000 admits all
    sessions."""
    idle_limit_s: Annotated[float, Meta(ge=1, le=86400)] = 60.0
    """Seconds without audio after which control closes a session."""
    lost_after_s: Annotated[float, Meta(ge=0.5, le=3600)] = 0.9
    """Seconds without a heartbeat after which control declares a service lost. For drivers,
    gateways and workers without sessions, the limit is 0.75 s longer."""

    @property
    def bound_control(self) -> str:
        """Endpoint that control binds."""
        host, _ = split_endpoint(self.control, "control")
        is_own = host in WILDCARDS or is_address(host) or is_loopback(host)
        return self.control if is_own else with_host(self.control, "0.0.0.0")  # noqa: S104 - documented

    @property
    def advertised_host(self) -> str:
        """Host name of control and its events for other machines."""
        host, _ = split_endpoint(self.control, "control")
        return local_address() if is_loopback(host) or host in WILDCARDS else host
