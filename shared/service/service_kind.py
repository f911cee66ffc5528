"""The declaration of a kind of service."""

from __future__ import annotations

import pkgutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kouxing.shared.service.base import Service
    from kouxing.shared.settings.config import ServiceConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceKind:
    """One kind of service. Its classes are imported when they are needed."""

    name: str
    role: str  # worker: placed in sessions; observer: takes part in all sessions
    summary: str = ""
    provides: tuple[str, ...] = ()  # endpoints of sessions that only this kind may provide
    needs: tuple[str, ...] = ()  # endpoints of sessions that it connects to
    client_roles: tuple[str, ...] = ()  # roles of its key, in addition to service:NAME

    @property
    def key_roles(self) -> tuple[str, ...]:
        """The roles of its key."""
        return (f"service:{self.name}", *self.client_roles)

    @property
    def config_type(self) -> type[ServiceConfig]:
        """The class of its configuration, such as ``ControlConfig``."""
        config_type: type[ServiceConfig] = self._import_class("config")
        return config_type

    @property
    def service_type(self) -> type[Service]:
        """The class of the service, such as ``ControlService``."""
        service_type: type[Service] = self._import_class("service")
        return service_type

    def _import_class(self, module: str) -> Any:
        class_name = self.name.title() + module.title()
        return pkgutil.resolve_name(f"kouxing.services.{self.name}.{module}:{class_name}")
