"""Fixtures of the unit tests."""

from collections.abc import Iterator

import pytest

from kouxing.corpora import parallel


@pytest.fixture
def one_thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """PyTorch computes on one thread, so that sums come out the same everywhere.

    Training starts one process at a time instead of one per core, because each one of them reads
    the models again.
    """
    import torch  # noqa: PLC0415 (slow to load; most tests do without)

    monkeypatch.setattr(parallel, "num_cores", lambda: 1)
    monkeypatch.setattr(parallel, "_MIN_CORES", 1)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
