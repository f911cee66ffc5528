"""Gives workers the list of allowed keys, again after each change."""

from kouxing.shared.network.zap import Zap
from kouxing.shared.wire.control import AllowedKey, Heartbeat


class KeyDistributor:
    """Remembers which version of the list each worker has."""

    def __init__(self, zap: Zap | None) -> None:
        self._zap = zap
        self._versions: dict[str, tuple[int, int]] = {}  # of the sent list, by worker instance

    def next_key_update(self, heartbeat: Heartbeat) -> dict[str, AllowedKey] | None:
        """Return the list for a worker's next reply; None if the worker has the list already."""
        zap, instance = self._zap, heartbeat.instance
        if zap is None or heartbeat.role != "worker" or self._versions.get(instance) == zap.version:
            return None
        self._versions[instance] = zap.version
        return {
            public: AllowedKey(name=grant.name, roles=list(grant.roles))
            for public, grant in zap.grants.items()
        }

    def forget(self, instance: str) -> None:
        """Forget a worker that is gone."""
        self._versions.pop(instance, None)
