"""``kouxing run``: everything at once, as ``make demo`` and ``make run`` do it."""

from __future__ import annotations

import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import av
import pytest

from tests.system import DEMO, ROOT, kouxing, own_environment

pytestmark = pytest.mark.e2e
SENTENCE = DEMO / "vowels-male.wav"


def test_the_demo_leaves_a_video_and_ends(tmp_path: Path) -> None:
    result = kouxing(
        "run", "--play", SENTENCE, "--stop-after", environment=own_environment(tmp_path)
    )
    assert result.returncode == 0, result.stderr
    assert "demo.mp4" in result.stderr
    with av.open(str(tmp_path / "demo.mp4")) as film:
        assert len(film.streams.audio) == 1
        assert sum(1 for _ in film.decode(video=0)) >= 2.2 * 25


def test_it_runs_until_it_is_interrupted(tmp_path: Path) -> None:
    environment = own_environment(tmp_path)
    running = subprocess.Popen(
        [sys.executable, "-m", "services", "run", "--no-browser"],
        env=environment,
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        begun = ""
        while "ready:" not in begun:
            line = running.stderr.readline() if running.stderr else ""
            assert line, f"it ended: {begun}"
            begun += line
        page = f"http://127.0.0.1:{environment['KOUXING_GATEWAY_PORT']}/"
        assert page.rstrip("/") in begun
        with urllib.request.urlopen(page) as answer:
            assert "kouxing" in answer.read().decode()
        spoken = kouxing("speak", SENTENCE, environment=environment)
        assert spoken.returncode == 0, spoken.stderr
        running.send_signal(signal.SIGINT)
        _, log = running.communicate(timeout=60)
    finally:
        running.kill()
        running.communicate()
    assert running.returncode == 0, log
    assert "Traceback" not in log


def test_a_wrong_configuration_ends_it_with_the_key(tmp_path: Path) -> None:
    config = tmp_path / "kouxing.toml"
    config.write_text("[synthesizer]\ndelay_ms = 5000\n", encoding="utf-8")
    result = kouxing("run", "--config", config, environment=own_environment(tmp_path))
    assert result.returncode == 2
    assert result.stderr.startswith("kouxing: synthesizer.delay_ms")  # and nothing was started
