"""Progress lines of training."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Report = Callable[[str], None]
T = TypeVar("T")


def with_progress(items: Sequence[T], what: str, report: Report) -> Iterator[T]:
    """Yield the items, and report after each tenth of them."""
    step = math.ceil(len(items) / 10)
    for number, item in enumerate(items, start=1):
        yield item
        if number % step == 0 or number == len(items):
            report(f"{number} of {len(items)} recordings {what}")
