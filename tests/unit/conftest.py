"""Fixtures of the unit tests."""

from collections.abc import Iterator

import pytest


@pytest.fixture
def one_thread() -> Iterator[None]:
    """PyTorch computes on one thread, so that sums come out the same everywhere."""
    import torch  # noqa: PLC0415 (slow to load; most tests do without)

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
