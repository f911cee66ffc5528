"""Writes logs as JSON lines to standard error. A line names its session, never speech content."""

import json
import logging
import sys
import time

LOG = logging.getLogger("kouxing")
LIBRARY_PERIOD_S = 60.0


class _JsonFormatter(logging.Formatter):
    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, object] = {
            "time": round(record.created, 3),
            "level": record.levelname.lower(),
            "service": self._service,
            "message": record.getMessage(),
        }
        if session := getattr(record, "session", ""):
            line["session"] = session
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


class RateLimit:
    """Allows each kind of warning once per ``period_s``."""

    def __init__(self, period_s: float = 5.0) -> None:
        self._period_s = period_s
        self._last_s: dict[str, float] = {}

    def allows(self, name: str) -> bool:
        """Return whether a warning of this kind may be logged now."""
        now_s = time.monotonic()
        if now_s - self._last_s.get(name, -self._period_s) < self._period_s:
            return False
        self._last_s[name] = now_s
        return True


def configure(service: str, level: str) -> None:
    """Send the log of this process to standard error as JSON lines.

    Each log line of a library is logged once per ``LIBRARY_PERIOD_S``, because clients may cause
    it. Lines about closed connections are not logged.
    """
    limit = RateLimit(LIBRARY_PERIOD_S)

    def is_logged(line: logging.LogRecord) -> bool:
        is_disconnect = line.exc_info is not None and isinstance(line.exc_info[1], OSError)
        return not is_disconnect and limit.allows(f"{line.pathname}:{line.lineno}")

    handler, for_libraries = logging.StreamHandler(sys.stderr), logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonFormatter(service))
    LOG.handlers[:] = [handler]
    LOG.setLevel(level.upper())
    LOG.propagate = False
    for_libraries.setFormatter(_JsonFormatter(service))
    for_libraries.addFilter(is_logged)
    logging.basicConfig(handlers=[for_libraries], level=logging.WARNING)
