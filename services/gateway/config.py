"""The gateway's configuration."""

from __future__ import annotations

from shared.config import BoundHost, BoundPort, ServiceConfig


class GatewayConfig(ServiceConfig):
    """The gateway's own keys."""

    host: BoundHost = "127.0.0.1"
    """Address at which the page is served."""
    port: BoundPort = 8080
    """Port at which the page is served; 0 takes a free one."""
    head: str = ""
    """Another head for the page: a GLB that 'kouxing head export' wrote."""
