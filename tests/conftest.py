"""The running system that end-to-end tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.system import System


@pytest.fixture(scope="session")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    """Control, recognizer, synthesizer and driver on this host."""
    folder = tmp_path_factory.mktemp("system")
    with System(("control", "recognizer", "synthesizer", "driver"), folder) as running:
        yield running
