"""The metrics of running services are those of the documents and of the dashboard."""

import json
import re
import urllib.request
from collections.abc import Iterator

import pytest
from kouxing_client import Client, FapFrame
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from kouxing.shared.audio_file import read_audio
from kouxing.shared.config import variable
from tests.raw_bytes import pour
from tests.system import CHAIN, LIMIT_S, ROOT, VOWELS_FILE, System, free_port

ELSEWHERE = {  # metrics of other services, or of what does not happen here
    *("frames_missed", "videos", "video_seconds", "repeated", "other_epoch", "too_early"),
    "skipped_audio_seconds",
}
SUFFIXES = ("_total", "_bucket", "_count", "_sum")


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    settings = {variable(name, "metrics_port"): str(free_port()) for name in CHAIN}
    with System(CHAIN, tmp_path_factory.mktemp("system"), settings) as running:
        yield running


@pytest.fixture(scope="module")
def families(system: System) -> dict[str, list[Metric]]:
    """Metrics of each service while a session is open."""
    ports = [int(system.environment[variable(name, "metrics_port")]) for name in CHAIN]
    with Client(system.control) as client:
        samples, rate_hz = read_audio(VOWELS_FILE)
        session = client.open_session(encoding="f32le", sample_rate_hz=rate_hz)
        output = session.results(FapFrame, keep_all=True)
        session.push(samples)
        session.finish()
        assert list(output)
        before = _heartbeats(client)
        system.wait_until(lambda _: _heartbeats(client) > before + 5)  # they set the gauges
        for port in ports:
            pour(port, 0.2)  # which the pages outlast
        pages = [[*text_string_to_metric_families(_page(port))] for port in ports]
    return dict(zip(CHAIN, pages, strict=True))


def _heartbeats(client: Client) -> float:
    (control,) = (state for state in client.status().services if state.service == "control")
    return control.metrics.get("in_heartbeat", 0.0)  # control's own heartbeat has them


def _page(port: int) -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=LIMIT_S) as page:
        text: str = page.read().decode()
        return text


def _names(families: dict[str, list[Metric]]) -> set[str]:
    return {family.name for item in families.values() for family in item}


def test_every_metric_is_documented(families: dict[str, list[Metric]]) -> None:
    page = (ROOT / "docs" / "metrics.md").read_text("utf-8")
    documented = {
        re.sub("_total$", "", name) for name in re.findall(r"`((?:kouxing|process)_\w+)`", page)
    }
    elsewhere = {f"kouxing_{name}" for name in ELSEWHERE}
    assert documented == {re.sub("_total$", "", name) for name in _names(families)} | elsewhere


def test_the_dashboard_uses_only_known_metrics(families: dict[str, list[Metric]]) -> None:
    dashboard = json.loads((ROOT / "deploy" / "grafana.json").read_text("utf-8"))
    served = {name for item in families.values() for family in item for name in _forms(family)}
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            names = re.findall(r"\b(?:kouxing|process)_\w+", target["expr"])
            assert names, panel["title"]
            assert set(names) <= served, panel["title"]


def _forms(family: Metric) -> set[str]:
    suffixes = {"counter": SUFFIXES[:1], "histogram": SUFFIXES[1:], "gauge": ("",)}
    return {f"{family.name}{suffix}" for suffix in suffixes[family.type]}
