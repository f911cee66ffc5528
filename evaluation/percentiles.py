"""Percentiles of measured values."""

import numpy as np

from kouxing.shared.arrays import Doubles


def percentiles(values: Doubles) -> dict[str, float]:
    """Return the 50th and the 95th percentile, ``p50`` and ``p95``; empty without values."""
    if not values.size:
        return {}
    return {f"p{percent}": float(np.percentile(values, percent)) for percent in (50, 95)}
