"""Ctrl-C ends a command, even if a library drops the exception."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.system import CODE_PATH, CTRL_C_COMMAND, LIMIT_S, VOWELS_FILE, start_python

INSTALL = """
import signal
from kouxing.shared.interrupt import catch_interrupt, install_interrupt_handler
install_interrupt_handler()
"""
LIBRARY_DROPS_INTERRUPT = """
try:
    try:
        signal.raise_signal(signal.SIGINT)
    except:
        pass
    while True:
        signal.pause()
except KeyboardInterrupt:
    print("raised again")
"""
INTERRUPT_DURING_CLEANUP = """
try:
    try:
        signal.raise_signal(signal.SIGINT)
    finally:
        try:
            raise ValueError
        except ValueError:
            signal.pause()  # until the exception is due again
        signal.pause()
        print("cleaned up")
except KeyboardInterrupt:
    print("raised once")
"""
CAUGHT_INTERRUPT = """
with catch_interrupt():
    signal.raise_signal(signal.SIGINT)
print(signal.getitimer(signal.ITIMER_REAL))
"""
INTERRUPT_IN_EXPORTER = """
from kouxing.services.cli.system.follow import _iter_until_interrupt
class Frames:
    has_ended = False
    def get(self, timeout_s):
        return "frame"
frames = []
for frame in _iter_until_interrupt(Frames(), "s"):
    frames.append(frame)
    if len(frames) == 3:
        signal.raise_signal(signal.SIGNAL)
print(*frames, signal.getitimer(signal.ITIMER_REAL))
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("raised while the file is written")
"""
# `CTRL_C_COMMAND` runs as the command line, with Ctrl-C in a function that FFmpeg calls.
INTERRUPT_IN_FFMPEG = """
import signal
from kouxing.shared.audio import media_file
call = media_file._GuardedFile._call
presses = [signal.SIGINT]

def interrupt(*arguments):
    if presses:
        signal.raise_signal(presses.pop())
    return call(*arguments)

media_file._GuardedFile._call = interrupt
"""
INTERRUPT_IN_OPTIONS = """
import signal
import typer.main
typer.main.get_group = lambda _: signal.raise_signal(signal.SIGINT)
"""
HANG_IN_SHUTDOWN = """
import atexit, threading
atexit.register(threading.Event().wait)
"""
INTERRUPT_IN_IMPORT = """
import signal
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    raise ImportError("initialization failed")
"""
# Each command runs in a process of its own, with Ctrl-C when it opens a file in the folder `data`
# or starts a program.
INTERRUPT_EACH_COMMAND = """
import importlib, json, os, signal, sys
for name in ("gmm.recipe", "encoder.recipe", "lips.recipe", "heads.assemble"):
    importlib.import_module(f"kouxing.training.{name}")
import kouxing.evaluation.commands
import kouxing.services.cli.main
from kouxing.shared.interrupt import install_interrupt_handler

def interrupt(event, arguments):
    is_input = event == "open" and "/data/" in str(arguments[0])
    if not is_pressed and (is_input or event == "subprocess.Popen"):
        is_pressed.append(True)
        signal.raise_signal(signal.SIGINT)

is_pressed = []
sys.addaudithook(interrupt)
results = {}
for line in sys.argv[1:]:
    sys.argv[1:] = line.split()
    if not (child := os.fork()):
        install_interrupt_handler()
        try:
            kouxing.services.cli.main.main()
        finally:
            os._exit(1)
    results[line] = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print(json.dumps(results))
"""
# They read a table, read with other processes, read clips, read a mesh, load a model and start
# programs. No command handles Ctrl-C itself.
COMMANDS = (
    "train gmm --corpus {data} -o {out}/a.npz",
    "train encoder --corpus {data} --whisper {data} --sounds {data} --clips {data} -o {out}/a.npz",
    "train lips --clips {data} -o {out}/a.npz",
    "train heads man --parts {data} -o {out}",
    "evaluate schemes --clips {data} --json {out}/a.json",
    "bench load --json {out}/a.json",
)


PREAMBLES = {
    "import": "",
    "shutdown": HANG_IN_SHUTDOWN + INTERRUPT_IN_FFMPEG,
    "options": INTERRUPT_IN_OPTIONS,
}


@pytest.mark.parametrize(
    ("program", "printed"),
    [
        (LIBRARY_DROPS_INTERRUPT, "raised again\n"),
        (INTERRUPT_DURING_CLEANUP, "cleaned up\nraised once\n"),
        (CAUGHT_INTERRUPT, "(0.0, 0.0)\n"),
    ],
)
def test_an_interrupt_is_raised_until_it_is_handled(program: str, printed: str) -> None:
    process = start_python("-c", INSTALL + program)
    assert process.communicate(timeout=LIMIT_S) == (printed, "")


@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
def test_ctrl_c_while_a_frame_is_exported_keeps_all_frames(number: str) -> None:
    program = INTERRUPT_IN_EXPORTER.replace("signal.SIGNAL", f"signal.{number}")
    process = start_python("-c", INSTALL + program)
    printed, log = process.communicate(timeout=LIMIT_S)
    assert printed == "frame frame frame (0.0, 0.0)\nraised while the file is written\n"
    assert log == "following session s\n"


@pytest.mark.parametrize("place", PREAMBLES)
def test_a_library_cannot_turn_ctrl_c_into_a_result(tmp_path: Path, place: str) -> None:
    if place == "import":
        (tmp_path / "onnxruntime.py").write_text(INTERRUPT_IN_IMPORT)
    path = f"{tmp_path}{os.pathsep}{CODE_PATH}"
    command = PREAMBLES[place] + CTRL_C_COMMAND
    process = start_python("-c", command, "phones", str(VOWELS_FILE), PYTHONPATH=path)
    printed, log = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, printed) == (130, "")
    assert "Traceback" not in log


def test_ctrl_c_ends_rhubarb_without_a_traceback() -> None:
    command = CTRL_C_COMMAND.replace("import main\nmain()", "import rhubarb\nrhubarb()")
    process = start_python("-c", INTERRUPT_IN_FFMPEG + command, "-q", str(VOWELS_FILE))
    assert process.communicate(timeout=LIMIT_S) == ("", "")
    assert process.returncode == -signal.SIGINT


@pytest.mark.slow
def test_ctrl_c_ends_every_kind_of_command_and_leaves_no_output(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    data.mkdir()
    out.mkdir()
    for name in ("manifest.tsv", "model.bin", "a.flac", "a.csv", "a.json"):
        (data / name).touch()
    lines = [line.format(data=data, out=out) for line in COMMANDS]
    process = start_python("-c", INTERRUPT_EACH_COMMAND, *lines)
    printed, log = process.communicate(timeout=4 * LIMIT_S)
    assert process.returncode == 0, log
    assert json.loads(printed) == dict.fromkeys(lines, 130), log
    assert log == ""
    assert not [*out.iterdir()]


def test_onnxruntime_stores_no_usage_data(tmp_path: Path) -> None:
    program = "import kouxing.services.recognizer.acoustic.onnx_session"
    without_ci = {"CI": "", "ORT_DISABLE_TELEMETRY": ""}
    process = start_python("-c", program, HOME=str(tmp_path), **without_ci)
    assert process.communicate(timeout=LIMIT_S) == ("", "")
    assert [*tmp_path.iterdir()] == []
