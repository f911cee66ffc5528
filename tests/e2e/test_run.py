"""``kouxing run``, as ``make demo`` and ``make run`` start it, and Ctrl-C at several stages."""

import contextlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import av
import pytest
import soundfile

from tests.e2e.conftest import CommandRunner
from tests.system import (
    CTRL_C_COMMAND,
    HELLO,
    LIGHT_MODEL,
    LIMIT_S,
    VIDEO_RATE_HZ,
    child_environment,
    kouxing,
    own_addresses,
    own_environment,
    start_python,
    wait_until,
)


@pytest.fixture(scope="module")
def speech(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of speech."""
    path = tmp_path_factory.mktemp("speech") / "speech.wav"
    soundfile.write(path, HELLO[:16_000], 16_000)
    return path


def test_the_demo_writes_a_video_and_stops(tmp_path: Path, speech: Path) -> None:
    result = kouxing("run", "--play", speech, "--stop-after", environment=own_environment(tmp_path))
    assert result.returncode == 0, result.stderr
    assert "demo.mp4" in result.stderr
    with av.open(str(tmp_path / "demo.mp4")) as film:
        assert len(film.streams.audio) == 1
        assert sum(1 for _ in film.decode(video=0)) >= 0.9 * VIDEO_RATE_HZ


def test_runs_on_free_ports_until_it_is_interrupted(
    command: CommandRunner, tmp_path: Path, speech: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {"XDG_RUNTIME_DIR": str(tmp_path), **LIGHT_MODEL}
    options = ["--set", "driver.view=none", "--set", f"driver.out={tmp_path}", "--no-browser"]
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # another program uses it, which has the same effect
            stack.enter_context(socket.create_server(("127.0.0.1", 5550)))
        running = start_python(
            "-m", "kouxing", "run", *options, "--port", "0", "--workers", "2", **environment
        )
        stack.callback(running.communicate)
        stack.callback(running.kill)
        log = ""
        while "ready:" not in log:
            line = running.stderr.readline() if running.stderr else ""
            assert line, f"it ended: {log}"
            log += line
        assert "tcp://127.0.0.1:5550" in log.splitlines()[0]  # is in use
        port = re.findall(r"the face is at http://127.0.0.1:(\d+)\n", log)[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            assert "kouxing" in answer.read().decode()
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        status, _, stderr = command("speak", speech)
        assert status == 0, stderr
        _, shown, _ = command("status")
        assert (len(re.findall("recognizer-", shown)), len(re.findall("driver-", shown))) == (2, 1)
        running.send_signal(signal.SIGINT)
        _, rest = running.communicate(timeout=LIMIT_S)
    assert running.returncode == 0, rest
    assert "Traceback" not in rest


def test_reports_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    environment = own_environment(tmp_path) | {"KOUXING_DRIVER_OUT": str(tmp_path / "out")}
    (tmp_path / "out/logs/recognizer.log").mkdir(parents=True)
    result = kouxing("run", environment=environment)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
    assert "/logs/recognizer.log: it is not a regular file" in result.stderr
    shutil.rmtree(tmp_path / "out")
    (tmp_path / "out").touch()
    result = kouxing("run", environment=environment)
    assert (result.returncode, len(result.stderr.splitlines())) == (2, 1)
    assert "start kouxing in a folder that you can write to" in result.stderr


def test_names_the_option_of_a_port_that_is_taken(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        environment = own_environment(tmp_path) | {"KOUXING_DRIVER_OUT": str(tmp_path / "out")}
        result = kouxing("run", "--port", port, environment=environment)
    assert result.returncode == 2
    assert f"--port: another program uses port {port}" in result.stderr


def test_ctrl_c_stops_run_while_it_starts(tmp_path: Path) -> None:
    environment = {
        **child_environment(),
        **LIGHT_MODEL,
        **own_addresses(),
        "XDG_RUNTIME_DIR": str(tmp_path),
    }
    control = tmp_path / "out" / "logs" / "control.log"
    with subprocess.Popen(
        [sys.executable, "-c", CTRL_C_COMMAND, "run", "--no-browser"],
        env=environment,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            wait_until(lambda: control.exists() and control.read_text())
            process.send_signal(signal.SIGINT)
            _, log = process.communicate(timeout=LIMIT_S)
        finally:
            process.kill()
    assert process.returncode == 0
    assert "stopping" in log
    assert "Traceback" not in log
