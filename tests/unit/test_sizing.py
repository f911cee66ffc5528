"""The page about hosts and cores: its tables follow from what was measured."""

from __future__ import annotations

import math
import re

import pytest

from kouxing.services.control.config import ControlConfig
from tests.system import ROOT

pytestmark = pytest.mark.unit
PAGE = (ROOT / "docs" / "sizing.md").read_text("utf-8")
WORKERS_OF_CONTROL = 1000
CORES_OF_HOST = 32


def row(first: str) -> list[float]:
    """Return the figures of a table's row."""
    (line,) = re.findall(rf"^\| {first} \|(.*)\|$", PAGE, re.MULTILINE)
    return [float(cell.replace(",", "")) for cell in line.split("|")]


@pytest.mark.parametrize("num_speakers", [100, 10_000, 1_000_000])
def test_hosts_and_cores_follow_from_one_session(num_speakers: int) -> None:
    num_workers, memory_mb = [], 0.0
    for kind in ("recognizer", "synthesizer"):
        cores, process_mb, session_mb = row(kind)
        num = math.ceil(num_speakers / int(ControlConfig().max_load / cores)) + 1
        num_workers.append(num)
        memory_mb += num * process_mb + num_speakers * session_mb
    num_controls = math.ceil(sum(num_workers) / WORKERS_OF_CONTROL)
    num_cores = sum(num_workers) + num_controls
    assert row(f"{num_speakers:,}") == [
        *num_workers,
        num_cores,
        round(memory_mb / 1e3),
        math.ceil(num_cores / CORES_OF_HOST),
        num_controls,
    ]
    assert f"about {WORKERS_OF_CONTROL} workers" in PAGE
