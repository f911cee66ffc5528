"""The command line with good and bad files, with and without running services."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Client, FapFrame, Refused, Results

from kouxing.shared.face.fap_file import read_fap
from kouxing.shared.face.faps import FAP_NUMBER
from kouxing.shared.face.shapes import ARKIT
from tests.e2e.following import samples_of_file, stream_into
from tests.system import ROOT, VOWELS_FILE, System, free_port, kouxing

pytestmark = pytest.mark.e2e
SENTENCE = VOWELS_FILE


@pytest.mark.parametrize("command", ["phones", "speak"])
def test_reports_a_bad_file_in_one_line(system: System, tmp_path: Path, command: str) -> None:
    path = tmp_path / "bad.wav"
    path.write_text("this is no sound", encoding="utf-8")
    result = kouxing(command, path, control=system.control)
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1
    assert "bad.wav" in result.stderr
    system.assert_all_alive()


def test_reports_a_missing_file_and_a_missing_system(tmp_path: Path) -> None:
    assert "no such file" in kouxing("phones", tmp_path / "nowhere.wav").stderr
    result = kouxing("status", control=f"tcp://127.0.0.1:{free_port()}")
    assert result.returncode == 2
    assert "kouxing run" in result.stderr


def test_speaks_a_truncated_file_of_another_format(system: System, tmp_path: Path) -> None:
    whole, truncated = tmp_path / "whole.wav", tmp_path / "truncated.wav"
    samples = np.repeat(samples_of_file(SENTENCE), 3)
    soundfile.write(whole, np.repeat(samples[:, None], 6, axis=1), 48000, subtype="PCM_24")
    data = whole.read_bytes()
    truncated.write_bytes(data[: len(data) * 3 // 4 + 1])
    result = kouxing("speak", truncated, "--fast", control=system.control)
    assert result.returncode == 0, result.stderr
    assert "no speech" not in result.stderr


@pytest.mark.parametrize(
    ("scale", "word"), [(0.0, "it is silent"), (30.0, "clipped")], ids=["silent", "clipped"]
)
def test_warns_of_silence_and_clipping(
    system: System, tmp_path: Path, scale: float, word: str
) -> None:
    path = tmp_path / "sound.wav"
    samples = np.clip(samples_of_file(SENTENCE) * scale, -1, 1)
    soundfile.write(path, samples, 16000)
    result = kouxing("speak", path, "--fast", control=system.control)
    assert result.returncode == 0, result.stderr
    assert word in result.stderr


def test_a_driver_that_was_lost_for_a_while_still_writes_its_video(tmp_path: Path) -> None:
    services = ("control", "recognizer", "synthesizer", "driver")
    with System(services, tmp_path, settings={"KOUXING_CONTROL_LOST_AFTER_S": "2"}) as running:
        driver = running.processes["driver"]
        command = [sys.executable, "-m", "kouxing", "speak", str(SENTENCE), "--record", "--fast"]
        speaker = subprocess.Popen(
            command, env=running.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True
        )
        running.wait_until(lambda report: len(report.sessions) > 0)
        driver.send_signal(signal.SIGSTOP)
        running.wait_until(
            lambda report: "driver" not in {state.service for state in report.services}
        )
        driver.send_signal(signal.SIGCONT)
        _, log = speaker.communicate(timeout=100)
    assert speaker.returncode == 0, log
    assert "wrote" in log


def test_speaks_raw_audio_from_standard_input(system: System) -> None:
    pcm = (samples_of_file(SENTENCE) * 32767).astype("<i2").tobytes()
    result = kouxing("speak", "-", "--fast", control=system.control, stdin=pcm)
    assert result.returncode == 0, result.stderr
    assert "phones in 2.3 s" in result.stderr


def test_phones_are_written_in_the_format_of_the_suffix(tmp_path: Path) -> None:
    table = tmp_path / "phones.csv"
    assert kouxing("phones", SENTENCE, "-o", table).returncode == 0
    with table.open(encoding="utf-8") as file:
        assert {"phone", "onset_s", "duration_s"} <= set(next(csv.DictReader(file)))
    assert "onset_s" in kouxing("phones", SENTENCE).stdout


def listening(control: str, *arguments: object, says: str) -> subprocess.Popen[str]:
    """Start ``kouxing listen``, and return after its first message."""
    listener = subprocess.Popen(
        [sys.executable, "-m", "kouxing", "listen", *map(str, arguments)],
        env={**os.environ, "KOUXING_CONTROL": control.partition(" ")[0]},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert listener.stderr is not None
    assert says in listener.stderr.readline()
    return listener


def test_listen_follows_a_session_from_its_start_to_its_end(system: System, tmp_path: Path) -> None:
    recorded, table = tmp_path / "face.fap", tmp_path / "face.csv"
    samples = samples_of_file(SENTENCE)
    waits = "waiting for session heard to open, as with kouxing speak my.wav --session heard"
    recorder = listening(system.control, "heard", "--output", recorded, says=waits)
    shaper = listening(system.control, "heard", "--as", "arkit", "-o", table, says=waits)
    printer = listening(system.control, "heard", "--show", "syllables", says=waits)
    with Client(system.control) as client:
        session = client.open_session(name="heard", encoding="f32le", paced=False)
        for listener in (recorder, shaper, printer):
            assert listener.stderr is not None
            assert listener.stderr.readline() == "following session heard\n"
        sent = stream_into(session, samples, chunk=320)
        session.close()
    _, log = recorder.communicate(timeout=100)
    assert recorder.returncode == 0, log
    animation = read_fap(recorded)
    assert animation.frame_rate_hz == 50
    np.testing.assert_allclose(animation.faps, sent.faps, atol=0.5)
    _, log = shaper.communicate(timeout=100)
    assert shaper.returncode == 0, log
    weights = np.genfromtxt(table, delimiter=",", names=True)
    assert weights.dtype.names == ("time_s", *ARKIT.names)
    jaw = [ARKIT.weights(faps)[ARKIT.names.index("jawOpen")] for faps in sent.faps]
    np.testing.assert_allclose(weights["jawOpen"], jaw, atol=1e-3)
    printed, log = printer.communicate(timeout=100)
    assert printer.returncode == 0, log
    spoken = [line.split()[-1] for line in printed.splitlines()]
    assert "sil" not in spoken
    assert set(spoken) & {"a", "e", "yi", "wu", "yu"}, printed


def test_listen_without_a_name_follows_the_newest_session(tmp_path: Path) -> None:
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path) as running, Client(running.control) as client:
        phones = ("--show", "phones")
        first = listening(running.control, *phones, says="waiting for a session to open")
        older = client.open_session(name="older", encoding="f32le")
        assert first.stderr is not None
        assert first.stderr.readline() == "following session older\n"
        newer = client.open_session(name="newer", encoding="f32le")
        second = listening(running.control, *phones, says="following session newer")
        for session, listener in ((newer, second), (older, first)):
            session.close()
            _, log = listener.communicate(timeout=100)
            assert log == f"session {session.name} ended: 0 phones\n"
            assert listener.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["listen", "two words"], "letters, digits"),
        (["listen", "heard", "-o", "face.txt"], ".jsonl"),
        (["listen", "heard", "-o", "face.fap", "--as", "vrm"], "this format holds faps"),
        (["listen", "heard", "--show", "phones", "--as", "vrm"], "cannot be combined"),
        (["listen", "heard", "-o", "nowhere/face.fap"], "mkdir -p nowhere"),
        (["speak", SENTENCE, "--session", "two words"], "letters, digits"),
        (["status", "--json", "nowhere/status.json"], "mkdir -p nowhere"),
        (["express", "heard", "glee=1"], "joy, sadness, anger"),
        (["express", "heard", "joy=2"], "between 0 and 1"),
        (["express", "heard", "joy"], "joy=0.4"),
        (["express", "heard", "joy=1", "--hold", "-1"], "0 to 3600"),
        (["express", "nobody", "joy=1"], "session 'nobody' does not exist"),
    ],
)
def test_rejects_wrong_arguments(system: System, arguments: list[str], word: str) -> None:
    result = kouxing(*arguments, control=system.control)
    assert result.returncode == 2
    assert word in result.stderr


def wait_for_lip_corner(faces: Results[FapFrame], low: float, high: float) -> None:
    """Wait until the lip corner is raised by ``low`` to ``high`` FAP units."""
    corner = FAP_NUMBER["raise_l_cornerlip"] - 1
    while (frame := faces.get(60.0)) is not None:
        if low < frame.values[corner] < high:
            return
    raise TimeoutError


def test_express_changes_the_face(system: System) -> None:
    with Client(system.control) as client:
        session = client.open_session(name="smiling")
        faces = session.results(FapFrame, keep_all=True)
        asked = kouxing("express", "smiling", "joy=1", "--hold", 600, control=system.control)
        assert asked.returncode == 0, asked.stderr
        wait_for_lip_corner(faces, 300.0, 400.0)  # the frames of a face at rest go on without sound
        session.set_face(expressions={"smile": 0.25, "squint": 1.0}, hold_s=600.0)
        wait_for_lip_corner(faces, 150.0, 200.0)
        session.set_face(expressions={})
        wait_for_lip_corner(faces, -50.0, 50.0)
        with pytest.raises(Refused, match="<= 1"):
            session.set_face(expressions={"joy": 1.5})
        session.close()


def test_status_shows_services_and_writes_json(system: System, tmp_path: Path) -> None:
    figures = tmp_path / "status.json"
    result = kouxing(
        "status", "--json", figures, control=system.control, environment={"COLUMNS": "80"}
    )
    assert result.returncode == 0, result.stderr
    instances = [line.split()[0] for line in result.stdout.splitlines() if " ready " in line]
    assert {name.partition("-")[0] for name in instances} >= {"recognizer", "synthesizer"}
    assert "…" not in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80
    services = json.loads(figures.read_text(encoding="utf-8"))["services"]
    assert {service["service"] for service in services} == {
        "control",
        "recognizer",
        "synthesizer",
        "driver",
    }


def test_a_command_writes_each_line_at_once() -> None:
    code = """
import os, signal
from kouxing.services.cli import main as command_line
command_line.app = lambda **_: (print("step 1"), os.kill(os.getpid(), signal.SIGKILL))
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
