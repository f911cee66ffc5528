"""The list of allowed keys, for the workers."""

from __future__ import annotations

from kouxing.shared.bus import Bus
from kouxing.shared.wire.control import AllowedKey, Heartbeat


class KeyList:
    """Gives each worker the list of allowed keys when the list has changed."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._sent_versions: dict[str, tuple[int, int]] = {}  # by worker

    def refresh(self) -> None:
        """Read the list again if it has changed."""
        if self._bus.zap is not None:
            self._bus.zap.refresh()

    def update_for(self, heartbeat: Heartbeat) -> dict[str, AllowedKey] | None:
        """Return the list, unless the worker has it already."""
        zap, instance = self._bus.zap, heartbeat.instance
        if zap is None or heartbeat.role != "worker":
            return None
        if self._sent_versions.get(instance) == zap.version:
            return None
        self._sent_versions[instance] = zap.version
        return {
            public: AllowedKey(name=grant.name, roles=list(grant.roles))
            for public, grant in zap.grants.items()
        }

    def forget(self, instance: str) -> None:
        """Send the list again when the worker returns."""
        self._sent_versions.pop(instance, None)
