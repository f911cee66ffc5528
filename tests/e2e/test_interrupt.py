"""Ctrl-C ends a command at every stage, without a traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.system import ONE_THREAD, ROOT, VOWELS_FILE

# A shell's background processes ignore Ctrl-C, and so do their children.
COMMAND = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from kouxing.__main__ import main
main()
"""
RUN = ["run", "--no-browser", "--port", "0", "--play", str(VOWELS_FILE)]


@contextmanager
def started(arguments: list[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a command that Ctrl-C can interrupt, as a shell does."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *arguments],
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(folder)},
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def interrupt(process: subprocess.Popen[str]) -> str:
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert "Traceback" not in rest
    return rest


def test_run_stops_while_it_starts(tmp_path: Path) -> None:
    with started(RUN, tmp_path) as process:
        wait_until((tmp_path / "out/logs/control.log").exists, process)
        assert "stopping" in interrupt(process)
        assert process.returncode == 0


def test_run_stops_while_the_sample_is_spoken(tmp_path: Path) -> None:
    with started(RUN, tmp_path) as process:
        assert process.stderr is not None
        assert "the face is at" in process.stderr.readline()
        rest = interrupt(process)
        assert process.returncode == 0
        assert "stopping" in rest
        assert "ready" not in rest


def test_an_interrupted_render_leaves_no_file(tmp_path: Path) -> None:
    with started(
        ["render", str(VOWELS_FILE), "face.mp4", "--size", "1920x1080"], tmp_path
    ) as process:
        wait_until(lambda: any(tmp_path.glob("*face*")), process)
        interrupt(process)
        assert process.returncode == 130
    assert not list(tmp_path.glob("*face*"))
