"""Wait for a condition in real time."""

import time
from collections.abc import Callable

_STEP_S = 0.03


def wait_until(condition: Callable[[], object], timeout_s: float) -> bool:
    """Wait until a condition holds; return False if it does not within ``timeout_s``."""
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(_STEP_S)
    return True
