"""Workers on a Ray cluster: placed, restarted on another node, and stopped."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from kouxing_client import Client, Status

from tests.e2e.streaming import stream_audio
from tests.system import VOWELS_FILE, System, kouxing, samples_of_file

if TYPE_CHECKING:
    from ray.cluster_utils import Cluster

NODE = {"num_cpus": 2, "object_store_memory": 80 << 20}
# without the processes that this test does not need
HEAD = NODE | {
    "num_cpus": 0,
    "include_dashboard": False,
    "include_log_monitor": False,
    "no_monitor": True,
}


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    from ray.cluster_utils import Cluster  # noqa: PLC0415 (slow to load; only this test needs it)

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_enable_worker_prestart", "0")
    cluster = Cluster(initialize_head=True, head_node_args=HEAD)
    try:
        cluster.add_node(**NODE)
        yield cluster
    finally:
        cluster.shutdown()


@pytest.fixture
def control(tmp_path: Path) -> Iterator[System]:
    with System(["control"], tmp_path, {"KOUXING_CONTROL_LOST_AFTER_S": "6"}) as running:
        yield running


def workers(report: Status) -> dict[str, str]:
    """Return the kinds of the workers by instance."""
    kinds = ("recognizer", "synthesizer")
    return {state.instance: state.service for state in report.services if state.service in kinds}


def test_workers_are_placed_restarted_elsewhere_and_stopped(
    nodes: Cluster, control: System
) -> None:
    def scale(**numbers: int) -> str:
        options = [text for name, number in numbers.items() for text in (f"--{name}", number)]
        environment = control.environment | {"RAY_ADDRESS": nodes.address}
        done = kouxing("cluster", *options, environment=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    listed = scale(recognizers=1, synthesizers=1)
    assert "recognizer-0" in listed
    assert "synthesizer-0" in listed
    control.wait_until(lambda report: len(workers(report)) == 2)
    with Client(control.control) as client:
        first = workers(client.status())
    samples = samples_of_file(VOWELS_FILE)
    assert stream_audio(control.control, samples).frames

    (lost,) = nodes.worker_nodes
    nodes.add_node(**NODE)
    nodes.remove_node(lost)
    control.wait_until(
        lambda report: (
            sorted(workers(report).values()) == ["recognizer", "synthesizer"]
            and workers(report) != first
        )
    )
    assert stream_audio(control.control, samples).frames

    assert "waits for a free core" in scale(recognizers=2)
    assert "no workers are running" in scale(recognizers=0, synthesizers=0)
    control.wait_until(lambda report: not workers(report))


def test_the_error_says_how_to_start_a_cluster() -> None:
    refused = kouxing("cluster")
    assert refused.returncode == 2
    assert "start one with 'ray start --head'" in refused.stderr
