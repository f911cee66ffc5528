"""The declaration of a kind of service."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from kouxing.shared.config import ServiceConfig
    from kouxing.shared.service import Service


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceKind:
    """One kind of service. Its classes are imported when they are needed."""

    name: str
    role: str  # worker: placed in sessions; observer: takes part in all sessions
    summary: str = ""
    config: str = ""  # configuration class, as module:class
    service: str = ""  # service class, as module:class
    provides: tuple[str, ...] = ()  # endpoints of sessions that only this kind may provide
    needs: tuple[str, ...] = ()  # endpoints of sessions that it connects to
    client_roles: tuple[str, ...] = ()  # roles of its key, in addition to service:NAME

    @property
    def key_roles(self) -> tuple[str, ...]:
        """The roles of its key."""
        return (f"service:{self.name}", *self.client_roles)

    @property
    def config_type(self) -> type[ServiceConfig]:
        """The class of its configuration."""
        config_type: type[ServiceConfig] = pkgutil.resolve_name(self.config)
        return config_type

    @property
    def service_type(self) -> type[Service]:
        """The class of the service."""
        service_type: type[Service] = pkgutil.resolve_name(self.service)
        return service_type
