"""The command line with good and bad files, with and without running services."""

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Client, FapFrame, Refused

from kouxing.services.service_kinds import KINDS
from kouxing.shared.face.fap_file import read_fap
from kouxing.shared.face.faps import FAP_NUMBER
from tests.e2e.conftest import CommandRunner
from tests.e2e.streaming import StreamedSession
from tests.receivers import read_osc
from tests.system import (
    LIMIT_S,
    ROOT,
    VOWELS_FILE,
    System,
    kouxing,
    samples_of_file,
    start_python,
    wait_until,
)

SENTENCE = VOWELS_FILE


@pytest.fixture
def command(
    system: System, command: CommandRunner, monkeypatch: pytest.MonkeyPatch
) -> CommandRunner:
    monkeypatch.setenv("KOUXING_CONTROL", system.control.partition(" ")[0])
    return command


@pytest.mark.parametrize(("scale", "word"), [(0.0, "it is silent"), (30.0, "clipped")])
def test_silence_and_clipping_give_warnings(
    command: CommandRunner, tmp_path: Path, scale: float, word: str
) -> None:
    path = tmp_path / "sound.wav"
    soundfile.write(path, np.clip(samples_of_file(SENTENCE)[:16000] * scale, -1, 1), 16000)
    status, _, log = command("speak", path, "--fast")
    assert (status, word in log) == (0, True), log


def test_speak_sends_raw_audio_from_standard_input_and_saves_the_video(system: System) -> None:
    pcm = (samples_of_file(SENTENCE)[:16_000] * 32767).astype("<i2").tobytes()
    result = kouxing("speak", "-", "--fast", "--record", control=system.control, stdin=pcm)
    assert result.returncode == 0, result.stderr
    assert "phones in 1.0 s" in result.stderr
    assert "wrote" in result.stderr


def test_speak_closes_its_session_if_it_is_stopped(system: System) -> None:
    with Client(system.control) as client:
        arguments = ("speak", "-", "--raw", "--session", "ended")
        speaker = start_python("-m", "kouxing", *arguments, control=system.control)
        assert speaker.stdin is not None
        speaker.stdin.write("\0" * 64_000)
        speaker.stdin.flush()

        def is_open() -> bool:
            return any(state.session == "ended" for state in client.status().sessions)

        wait_until(is_open)
        speaker.send_signal(signal.SIGTERM)
        speaker.communicate(timeout=LIMIT_S)
        assert speaker.returncode == 128 + signal.SIGTERM
        assert not is_open()


def start_listening(control: str, *arguments: object, first_message: str) -> subprocess.Popen[str]:
    """Start ``kouxing listen``, and return after its first message."""
    listener = start_python("-m", "kouxing", "listen", *arguments, control=control)
    assert listener.stderr is not None
    assert first_message in listener.stderr.readline()
    return listener


def output_of(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Return the output of a program that must succeed."""
    output, log = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, log
    return output, log


def test_listen_follows_a_session_from_its_start_to_its_end(
    system: System, client: Client, tmp_path: Path
) -> None:
    recorded = tmp_path / "face.fap"
    waits = "waiting for session heard to open, as with kouxing speak my.wav --session heard"
    recorder = start_listening(system.control, "heard", "--output", recorded, first_message=waits)
    printer = start_listening(system.control, "heard", "--as", "syllables", first_message=waits)
    with client.open_session("heard", encoding="f32le", paced=False) as session:
        for listener in (recorder, printer):
            assert listener.stderr is not None
            assert listener.stderr.readline() == "following session heard\n"
        streamed = StreamedSession(session)
        streamed.send(samples_of_file(SENTENCE))
        streamed.finish()
    output_of(recorder)
    animation = read_fap(recorded)
    assert animation.frame_rate_hz == 50
    np.testing.assert_allclose(animation.faps, streamed.faps, atol=0.5)
    spoken = [line.split()[-1] for line in output_of(printer)[0].splitlines()]
    assert "sil" not in spoken
    assert {*spoken} & {"a", "e", "yi", "wu", "yu"}


def test_listen_writes_its_file_if_it_is_stopped(system: System, tmp_path: Path) -> None:
    recorded = tmp_path / "face.fap"
    with Client(system.control) as client, client.open_session("stopped"):
        listener = start_listening(
            system.control, "--output", recorded, first_message="following session stopped"
        )
        listener.send_signal(signal.SIGTERM)
        assert "wrote" in output_of(listener)[1]
    assert recorded.exists()


def test_listen_without_a_name_follows_the_newest_session(system: System, client: Client) -> None:
    with client.open_session("older"):
        newer = client.open_session("newer")
        listener = start_listening(
            system.control, "--as", "phones", first_message="following session newer"
        )
        newer.close()
        assert output_of(listener)[1] == "session newer ended: 0 phones\n"


def test_send_sends_the_face_at_rest_and_every_session_of_a_name(
    system: System, client: Client, command: CommandRunner
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(LIMIT_S)

        def weight(shape: str) -> float:
            while f"/kouxing/{shape}" not in (messages := dict(read_osc([program.recv(2000)]))):
                pass
            return float(messages[f"/kouxing/{shape}"][0])

        url = f"osc://127.0.0.1:{program.getsockname()[1]}"
        urls = f"{url}?shapes=vrm", url  # the last options of a target apply
        sender = start_python(
            "-m", "kouxing", "send", *urls, "--session", "sent", control=system.control
        )
        assert sender.stderr is not None
        assert f"sending ARKit shapes and head to {url}" in sender.stderr.readline()
        assert "waiting for session sent to open (open sessions: " in sender.stderr.readline()
        assert weight("jawOpen") == weight("mouthSmileLeft") == 0.0
        command("express", "smile=1", "--hold", "600")
        while weight("mouthSmileLeft") < 0.5:
            pass
        command("express")
        while weight("mouthSmileLeft") > 0.01:
            pass
        for _ in range(2):
            with client.open_session("sent", encoding="f32le", paced=False) as session:
                assert sender.stderr.readline() == "following session sent\n"
                session.push(samples_of_file(SENTENCE))
                session.finish()
                while weight("jawOpen") < 0.1:
                    pass
            while weight("jawOpen") > 0.01:  # until the face is at rest
                pass
        sender.send_signal(signal.SIGINT)
        output_of(sender)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["phones", "nowhere.wav"], "no such file"),
        (["speak", __file__], "test_command_line.py"),
        (["listen", "two words"], "letters, digits"),
        (["listen", "heard", "-o", "face.txt"], ".jsonl"),
        (["listen", "heard", "-o", "face.fap", "--as", "vrm"], "face.fap cannot contain vrm"),
        (["listen", "heard", "-o", "nowhere/face.fap"], "mkdir -p nowhere"),
        (["status", "--json", "nowhere/status.json"], "mkdir -p nowhere"),
        (["express", "heard", "joy=2"], "between 0 and 1"),
        (["express", "heard", "joy=1", "--hold", "-1"], "at most 3600"),
        (["express", "nobody", "joy=1"], "'nobody' does not exist (open sessions: none); to"),
    ],
)
def test_wrong_arguments_are_rejected(
    command: CommandRunner, arguments: list[str], word: str
) -> None:
    status, _, message = command(*arguments)
    assert status == 2
    assert word in message
    assert len(message.splitlines()) == 1


def test_express_changes_the_face(client: Client, command: CommandRunner) -> None:
    corner = FAP_NUMBER["raise_l_cornerlip"] - 1
    with client.open_session("smiling") as session:
        faces = session.results(FapFrame, keep_all=True)

        def wait_for_lip_corner(low: float, high: float) -> None:
            """Wait until the lip corner is raised by ``low`` to ``high`` FAP units."""
            while not low < faces.get(LIMIT_S).values[corner] < high:  # type: ignore[union-attr]
                pass

        status, _, message = command("express", "smiling", "joy=1", "--hold", 600)
        assert (status, message) == (0, "showing joy 1 for 600 s: smiling\n")
        wait_for_lip_corner(300.0, 400.0)  # a face at rest has frames without sound
        session.set_face(expressions={"smile": 0.25, "squint": 1.0}, hold_s=600.0)
        wait_for_lip_corner(150.0, 200.0)
        session.set_face(expressions={})
        wait_for_lip_corner(-50.0, 50.0)
        with pytest.raises(Refused, match=r"expression joy: strength 1\.5 is not between"):
            session.set_face(expressions={"joy": 1.5})


def test_status_shows_services_and_sessions_and_writes_json(system: System, tmp_path: Path) -> None:
    figures = tmp_path / "status.json"
    with Client(system.control) as client:
        session = client.open_session("live")

        def push() -> None:
            session.push(bytes(640))  # 20 ms
            time.sleep(0.02)

        def has_lateness() -> bool:
            sessions = client.status().sessions
            return any(state.session == "live" and state.lateness for state in sessions)

        wait_until(has_lateness, step=push)
        with ThreadPoolExecutor() as executor:
            running = executor.submit(
                kouxing,
                *("status", "--json", figures),
                control=system.control,
                environment={"COLUMNS": "80"},
            )
            while not running.done():
                push()
        result = running.result()
    assert result.returncode == 0, result.stderr
    instances = [line.split()[0] for line in result.stdout.splitlines() if " ready " in line]
    assert {*instances} >= {"recognizer", "synthesizer"}
    assert re.search(r"^live +open .* \d+, \d+, \d+ ms +\d\.\d s ", result.stdout, re.MULTILINE)
    assert "…" not in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80
    report = json.loads(figures.read_text(encoding="utf-8"))
    metrics = {service["service"]: service["metrics"] for service in report["services"]}
    assert metrics.keys() == {*KINDS}
    assert metrics["recognizer"]["network_hop"] >= 1
    assert "network_hop" in result.stdout
    (state,) = (state for state in report["sessions"] if state["session"] == "live")
    assert state["lateness"].keys() == {"p50_ms", "p95_ms", "worst_ms"}


def test_a_command_writes_each_line_at_once() -> None:
    code = """
import os, signal
from kouxing.services.cli import main as command_line
run = lambda **_: (print("step 1"), os.kill(os.getpid(), signal.SIGKILL))
command_line.typer.main.get_command = lambda _: run
command_line.main()
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | {"PYTHONUNBUFFERED": ""},
        capture_output=True,
        check=False,
        text=True,
    )
    assert done.stdout == "step 1\n"


LOADING = """
import sys
from kouxing.services.cli import main
from kouxing.services.cli.recordings import commands
SLOW = {"av", "numba", "onnxruntime", "scipy"}
commands.show_loading = lambda: sys.exit(f"loading {sorted(SLOW & sys.modules.keys())}")
main.main()
"""


@pytest.mark.parametrize(
    "command", ["render a.wav a.mp4", "phones a.wav", "align a.wav da", "lips a.wav a.svg"]
)
def test_progress_appears_before_slow_modules_are_imported(command: str) -> None:
    started = start_python("-c", LOADING, *command.split())
    assert started.communicate(timeout=LIMIT_S)[1] == "loading []\n"


KOUXING = [sys.executable, "-m", "kouxing"]
RHUBARB = [sys.executable, "-c", "from kouxing.services.cli.rhubarb import main; main()"]


@pytest.mark.parametrize(
    ("command", "closing", "status", "message"),
    [
        ([*KOUXING, "config"], ">&-", 0, ""),
        ([*KOUXING, "phones", "-"], "<&-", 2, "no audio arrived"),
        ([*RHUBARB, "-"], "<&-", 1, "no audio arrived"),
    ],
)
def test_standard_input_and_output_may_be_closed(
    command: list[str], closing: str, status: int, message: str
) -> None:
    run = ["sh", "-c", f"{shlex.join(command)} {closing}"]
    done = subprocess.run(run, cwd=ROOT, stderr=subprocess.PIPE, check=False, text=True)
    assert done.returncode == status
    assert message in done.stderr
    assert bool(done.stderr) == bool(message)


def test_rhubarb_reports_a_full_output() -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 (a device)
        command = [*RHUBARB, "-q", str(VOWELS_FILE)]
        done = subprocess.run(
            command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, check=False, text=True
        )
    error = "cannot write standard output: the disk is full; free some space\n"
    assert (done.returncode, done.stderr) == (1, error)


def test_an_error_keeps_its_status_if_its_log_is_full() -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 (a device)
        command = [*KOUXING, "phones", "missing.wav"]
        assert subprocess.run(command, cwd=ROOT, stderr=full, check=False).returncode == 2


def test_an_empty_argument_is_rejected() -> None:
    refused = kouxing("render", VOWELS_FILE, "")
    assert (refused.returncode, "an argument is empty" in refused.stderr) == (2, True)


@pytest.mark.parametrize(
    ("output", "problem"),
    [("/dev/full", "the disk is full; free some space"), ("out", "'ulimit -f' or the file system")],
)
def test_an_output_that_cannot_be_written_gives_one_line(
    tmp_path: Path, output: str, problem: str
) -> None:
    command = f"ulimit -f 0; exec {sys.executable} -m kouxing --version > {tmp_path / output}"
    done = subprocess.run(
        ["sh", "-c", command], cwd=ROOT, stderr=subprocess.PIPE, check=False, text=True
    )
    (line,) = done.stderr.splitlines()
    assert line.startswith("kouxing: cannot write the output: ")
    assert problem in line
    assert done.returncode == 2


def test_declining_an_overwrite_gives_one_line(tmp_path: Path) -> None:
    output = tmp_path / "my.glb"
    output.write_text("mine")
    terminal, other_end = os.openpty()
    command = [*KOUXING, "head", "export", str(output)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdin=other_end, stdout=other_end, stderr=other_end
    )
    os.write(terminal, b"n\n")
    assert process.wait(LIMIT_S) == 1
    os.close(other_end)
    shown = os.read(terminal, 10_000).decode()
    os.close(terminal)
    assert "Overwrite it? [y/N]" in shown
    assert shown.endswith("kouxing: aborted; nothing was written\r\n")
    assert output.read_text() == "mine"
