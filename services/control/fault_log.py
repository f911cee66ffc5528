"""Logs lost services: as information at first, as a warning if they do not return in time."""

from dataclasses import dataclass

from kouxing.shared.monitoring.logs import LOG

WARN_AFTER_S = 1.0  # time without a service after which its loss is a warning
MAX_FAULTS = 1000


@dataclass(slots=True)
class _Fault:
    start_s: float
    text: str
    is_warned: bool = False


class FaultLog:
    """The lost services. Warnings also reach the supervisor's console."""

    def __init__(self) -> None:
        self._faults: dict[str, _Fault] = {}  # by instance, oldest first

    def begin(self, instance: str, reason: str, now_s: float) -> None:
        """Record that a service is lost."""
        text = f"lost {instance}: {reason}"
        LOG.info(text)
        self._faults[instance] = _Fault(now_s, text)
        if len(self._faults) > MAX_FAULTS:
            del self._faults[next(iter(self._faults))]

    def warn(self, now_s: float) -> None:
        """Warn about each fault that has lasted longer than ``WARN_AFTER_S``."""
        for fault in self._faults.values():
            if not fault.is_warned and now_s - fault.start_s > WARN_AFTER_S:
                fault.is_warned = True
                LOG.warning(fault.text)

    def end(self, instance: str, now_s: float) -> float:
        """Record that a service has registered; return how long it was lost, seconds.

        The return is logged as a warning if the loss was.
        """
        fault = self._faults.pop(instance, None)
        if fault is None:
            return 0.0
        lasted_s = now_s - fault.start_s
        log = LOG.warning if fault.is_warned else LOG.info
        log("%s is back after %.1f s", instance, lasted_s)
        return lasted_s
