"""The command line with good and bad files, with and without running services."""

from __future__ import annotations

import csv
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import av
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


def empty(path: Path) -> None:
    path.touch()


def text(path: Path) -> None:
    path.write_text("this is no sound", encoding="utf-8")


def header_only(path: Path) -> None:
    path.write_bytes(SENTENCE.read_bytes()[:44])


def half_a_header(path: Path) -> None:
    path.write_bytes(SENTENCE.read_bytes()[:20])


def not_a_number(path: Path) -> None:
    samples = samples_of_file(SENTENCE)
    samples[20000] = np.nan
    soundfile.write(path, samples, 16000, subtype="FLOAT")


def too_low(path: Path) -> None:
    soundfile.write(path, np.zeros(4000, np.float32), 4000)


REFUSED = [
    (empty, "empty"),
    (text, "no audio"),
    (header_only, "no samples"),
    (half_a_header, "no audio"),
    (not_a_number, "NaN"),
    (too_low, "too low"),
]


@pytest.mark.parametrize(
    ("make", "word"), REFUSED, ids=lambda value: getattr(value, "__name__", "")
)
@pytest.mark.parametrize("command", ["phones", "speak"])
def test_bad_files_are_refused_in_one_line(
    system: System, tmp_path: Path, command: str, make: Callable[[Path], None], word: str
) -> None:
    path = tmp_path / "bad.wav"
    make(path)
    result = kouxing(command, path, *(["--fast"] * (command == "speak")), control=system.control)
    assert result.returncode == 2
    assert word in result.stderr
    assert "bad.wav" in result.stderr
    system.assert_all_alive()


def test_a_missing_file_and_a_missing_system_are_named(tmp_path: Path) -> None:
    assert "no such file" in kouxing("phones", tmp_path / "nowhere.wav").stderr
    nobody = f"tcp://127.0.0.1:{free_port()}"
    result = kouxing("status", control=nobody)
    assert result.returncode == 2
    assert "kouxing run" in result.stderr


def as_8_bit(path: Path) -> None:
    soundfile.write(path, samples_of_file(SENTENCE), 16000, subtype="PCM_U8")


def as_192_khz(path: Path) -> None:
    samples = samples_of_file(SENTENCE)
    positions = np.arange(len(samples) * 12) / 12
    fine = np.interp(positions, np.arange(len(samples)), samples)
    soundfile.write(path, fine, 192000, subtype="PCM_24")


def as_six_channels(path: Path) -> None:
    samples = samples_of_file(SENTENCE)
    soundfile.write(path, np.repeat(samples[:, None], 6, axis=1), 16000)


def truncated(path: Path) -> None:
    data = SENTENCE.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4 + 1])


@pytest.mark.parametrize("make", [as_8_bit, as_192_khz, as_six_channels, truncated])
def test_odd_files_are_spoken(system: System, tmp_path: Path, make: Callable[[Path], None]) -> None:
    path = tmp_path / "odd.wav"
    make(path)
    result = kouxing("speak", path, "--fast", control=system.control)
    assert result.returncode == 0, result.stderr
    assert "no speech" not in result.stderr


@pytest.mark.parametrize(
    ("scale", "word"), [(0.0, "it is silent"), (30.0, "clipped")], ids=["silent", "clipped"]
)
def test_silence_and_clipping_are_spoken_with_a_remark(
    system: System, tmp_path: Path, scale: float, word: str
) -> None:
    path = tmp_path / "sound.wav"
    samples = np.clip(samples_of_file(SENTENCE) * scale, -1, 1)
    soundfile.write(path, samples, 16000)
    result = kouxing("speak", path, "--fast", control=system.control)
    assert result.returncode == 0, result.stderr
    assert word in result.stderr


def test_a_driver_that_was_silent_for_a_while_still_writes_its_video(tmp_path: Path) -> None:
    services = ("control", "recognizer", "synthesizer", "driver")
    with System(services, tmp_path, settings={"KOUXING_CONTROL_LOST_AFTER_S": "2"}) as own:
        driver = own.processes["driver"]
        command = [sys.executable, "-m", "kouxing", "speak", str(SENTENCE), "--record", "--fast"]
        speaker = subprocess.Popen(
            command, env=own.environment, cwd=ROOT, stderr=subprocess.PIPE, text=True
        )
        own.wait_until(lambda report: len(report.sessions) > 0)
        driver.send_signal(signal.SIGSTOP)
        own.wait_until(lambda report: "driver" not in {each.service for each in report.services})
        driver.send_signal(signal.SIGCONT)
        _, log = speaker.communicate(timeout=100)
    assert speaker.returncode == 0, log
    assert "wrote" in log


def test_raw_sound_from_standard_input(system: System) -> None:
    pcm = (samples_of_file(SENTENCE) * 32767).astype("<i2").tobytes()
    result = kouxing("speak", "-", "--fast", control=system.control, stdin=pcm)
    assert result.returncode == 0, result.stderr
    assert "phones in 2.3 s" in result.stderr


def test_a_minute_of_silence_does_not_stop_the_voice_after_it(
    system: System, tmp_path: Path
) -> None:
    path = tmp_path / "long.flac"
    with soundfile.SoundFile(path, "w", 16000, 1) as file:
        file.write(np.zeros(60 * 16000, np.float32))
        file.write(samples_of_file(SENTENCE))
    result = kouxing("speak", path, "--fast", control=system.control)
    assert result.returncode == 0, result.stderr
    assert "no speech" not in result.stderr
    assert "62.3 s" in result.stderr


@pytest.mark.parametrize("form", ["table", "csv", "json", "textgrid"])
def test_phones_in_every_form(form: str) -> None:
    result = kouxing("phones", SENTENCE, "--format", form)
    assert result.returncode == 0, result.stderr
    if form == "csv":
        rows = list(csv.DictReader(io.StringIO(result.stdout)))
        assert {"phone", "onset_s", "duration_s"} <= set(rows[0])
    elif form == "json":
        assert json.loads(result.stdout)
    elif form == "textgrid":
        assert result.stdout.startswith('File type = "ooTextFile"')
    else:
        assert "onset_s" in result.stdout


def test_render_writes_a_video_without_services(tmp_path: Path) -> None:
    video = tmp_path / "face.mp4"
    result = kouxing("render", SENTENCE, video, "--size", "320x240")
    assert result.returncode == 0, result.stderr
    with av.open(str(video)) as film:
        stream = film.streams.video[0]
        assert (stream.width, stream.height) == (320, 240)
        assert sum(1 for _ in film.decode(video=0)) >= 2.2 * 25


def listening(control: str, *arguments: object, says: str) -> subprocess.Popen[str]:
    """Start ``kouxing listen`` and return once it says what is expected first."""
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


def test_listen_waits_for_a_session_and_ends_with_it(system: System, tmp_path: Path) -> None:
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
    with System(services, tmp_path) as own, Client(own.control) as client:
        phones = ("--show", "phones")
        first = listening(own.control, *phones, says="waiting for a session to open")
        older = client.open_session(name="older", encoding="f32le")
        assert first.stderr is not None
        assert first.stderr.readline() == "following session older\n"
        newer = client.open_session(name="newer", encoding="f32le")
        second = listening(own.control, *phones, says="following session newer")
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
        (["listen", "heard", "--show", "phones", "--as", "vrm"], "--as are for frames"),
        (["listen", "heard", "-o", "nowhere/face.fap"], "mkdir -p nowhere"),
        (["speak", SENTENCE, "--session", "two words"], "letters, digits"),
        (["status", "--json", "nowhere/status.json"], "mkdir -p nowhere"),
        (["express", "heard", "glee=1"], "joy, sadness, anger"),
        (["express", "heard", "joy=2"], "0 to 1"),
        (["express", "heard", "joy"], "joy=0.4"),
        (["express", "heard", "joy=1", "--hold", "-1"], "0 to 3600"),
        (["express", "nobody", "joy=1"], "no session 'nobody'"),
    ],
)
def test_a_running_system_is_not_asked_for_what_cannot_be(
    system: System, arguments: list[str], word: str
) -> None:
    result = kouxing(*arguments, control=system.control)
    assert result.returncode == 2
    assert word in result.stderr


def wait_for_corner(faces: Results[FapFrame], low: float, high: float) -> None:
    """Wait until the corner of the mouth is raised by so much, in FAP units."""
    corner = FAP_NUMBER["raise_l_cornerlip"] - 1
    while (frame := faces.get(60.0)) is not None:
        if low < frame.values[corner] < high:
            return
    raise TimeoutError


def test_a_face_shows_what_another_program_asks_for(system: System) -> None:
    with Client(system.control) as client:
        session = client.open_session(name="smiling")
        faces = session.results(FapFrame, keep_all=True)
        asked = kouxing("express", "smiling", "joy=1", "--hold", 600, control=system.control)
        assert asked.returncode == 0, asked.stderr
        wait_for_corner(faces, 300.0, 400.0)  # the frames of a face at rest go on without sound
        session.set_face(expressions={"smile": 0.25, "squint": 1.0}, hold_s=600.0)
        wait_for_corner(faces, 150.0, 200.0)
        session.set_face(expressions={})
        wait_for_corner(faces, -50.0, 50.0)
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


def test_lines_reach_a_log_file_at_once() -> None:
    """Killed in the middle, a command has written all the lines it printed."""
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
