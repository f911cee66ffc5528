"""Loads numba's runtime. This takes as long as loading the models, so it runs in parallel."""

import sys

from numba.core.registry import cpu_target

# numba imports these for matrix products and foreign functions. No compiled function here uses
# them, and numba loads in half the time without them.
_UNUSED = ("scipy.linalg.cython_blas", "cffi")


def load_numba() -> None:
    """Load numba's runtime before the first compiled function runs."""
    hidden = [name for name in _UNUSED if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # type: ignore[assignment] # its import fails
    try:
        cpu_target.target_context.refresh()
    finally:
        for name in hidden:
            del sys.modules[name]
