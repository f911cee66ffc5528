"""The programs in examples/subscribe follow a session."""

from __future__ import annotations

import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Client

from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send, stream_into
from tests.scripted_system import Gateway
from tests.system import ROOT, VOWELS_FILE, System, free_port

FOLDER = ROOT / "examples" / "subscribe"
STREAM_CLIENTS = ROOT / "examples" / "stream"
STREAM = ROOT / "examples" / "unity" / "KouxingStream.cs"
NODE = str(Path(sys.executable).with_name("node"))

pytestmark = pytest.mark.e2e


@pytest.fixture
def programs(tmp_path: Path) -> list[list[str]]:
    """The commands of the programs."""
    shutil.copy(FOLDER / "follow.mjs", tmp_path)
    (tmp_path / "node_modules").symlink_to(ROOT / "proto" / "node" / "node_modules")
    program = tmp_path / "follow"
    options = ["-std=c11", "-Wall", "-Werror", "-lzmq"]
    subprocess.run(["cc", FOLDER / "follow.c", "-o", program, *options], check=True)
    return [
        [sys.executable, str(FOLDER / "follow.py")],
        [NODE, str(tmp_path / "follow.mjs")],
        [str(program)],
    ]


@pytest.mark.parametrize("wav", ["mono 16", "stereo 24", "float 48k"])
def test_the_clients_stream_wav_files(system: System, tmp_path: Path, wav: str) -> None:
    samples, _ = soundfile.read(VOWELS_FILE, dtype="float32")
    samples, rate_hz, form = {
        "mono 16": (samples, 16000, "PCM_16"),
        "stereo 24": (np.stack([samples, samples], axis=1), 16000, "PCM_24"),
        "float 48k": (np.repeat(samples, 3), 48000, "FLOAT"),
    }[wav]
    soundfile.write(tmp_path / "said.wav", samples, rate_hz, form, format="WAVEX")
    shutil.copy(STREAM_CLIENTS / "client.mjs", tmp_path)
    (tmp_path / "node_modules").symlink_to(ROOT / "proto" / "node" / "node_modules")
    for program in (
        [sys.executable, str(STREAM_CLIENTS / "client.py")],
        [NODE, str(tmp_path / "client.mjs")],
    ):
        arguments = [*program, str(tmp_path / "said.wav"), system.control.partition(" ")[0]]
        output = subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True).stdout
        jaw = [float(line.split()[-1]) for line in output.splitlines()]
        assert len(jaw) == pytest.approx(50 * len(samples) / rate_hz, abs=50)
        assert max(jaw) - min(jaw) > 100


def test_without_a_server_each_program_prints_one_line(
    programs: list[list[str]], tmp_path: Path
) -> None:
    shutil.copy(STREAM_CLIENTS / "client.mjs", tmp_path)
    clients = [
        [sys.executable, str(STREAM_CLIENTS / "client.py")],
        [NODE, f"{tmp_path}/client.mjs"],
    ]
    address = f"tcp://127.0.0.1:{free_port()}"
    assistant = [sys.executable, str(ROOT / "examples" / "voice-assistant" / "assistant.py")]
    running = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for command in [
            *([*program, "", address] for program in programs),
            *([*client, str(VOWELS_FILE), address] for client in clients),
            [*assistant, address.replace("tcp", "ws")],
        ]
    ]
    for process in running:
        (line,) = process.communicate(timeout=60)[1].splitlines()
        assert "start it with: kouxing run" in line
        assert process.returncode == 1


def test_follow_a_session_to_its_end(system: System, programs: list[list[str]]) -> None:
    name = "followed-by-examples"
    address = system.control.partition(" ")[0]
    with ExitStack() as stack, Client(system.control) as client:
        running = [
            stack.enter_context(
                subprocess.Popen([*program, name, address], stdout=subprocess.PIPE, text=True)
            )
            for program in programs
        ]
        session = client.open_session(name=name, encoding="f32le", paced=False)
        for process in running:
            assert process.stdout is not None
            assert process.stdout.readline() == f"following {name}\n"
        stream_into(session, samples_of_file(VOWELS_FILE), chunk=1600)
        outputs = [process.communicate(timeout=60)[0].splitlines() for process in running]
        session.close()
    assert [process.returncode for process in running] == [0, 0, 0]
    assert outputs[0] == outputs[1] == outputs[2]
    times_s, jaw = zip(*(map(float, line.split()) for line in outputs[0]), strict=True)
    assert len(jaw) > 100
    assert sorted(times_s) == list(times_s)
    assert 0.2 < max(jaw) <= 1, "/a/ must open the jaw"
    assert min(jaw) == 0


def test_follow_a_session_that_moves(tmp_path: Path, programs: list[list[str]]) -> None:
    samples = samples_of_file(VOWELS_FILE)[:48000]
    services = ("control", "recognizer", "synthesizer")
    with ExitStack() as stack, System(services, tmp_path) as system:
        client = stack.enter_context(Client(system.control))
        session = client.open_session(encoding="f32le")
        address = system.control.partition(" ")[0]
        running = [
            stack.enter_context(
                subprocess.Popen(
                    [*program, session.name, address], stdout=subprocess.PIPE, text=True
                )
            )
            for program in programs
        ]
        for process in running:
            assert process.stdout is not None
            assert process.stdout.readline() == f"following {session.name}\n"
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:16000], output, collected, paced=True)
        system.start_beside("synthesizer", "other")
        lost = system.processes.pop("synthesizer")
        lost.kill()
        lost.wait()
        send(session, samples[16000:], output, collected, paced=True)
        finish(session, output, collected)
        assert session.info["epoch"] > 1
        outputs = [process.communicate(timeout=60)[0].splitlines() for process in running]
        session.close()
    assert [process.returncode for process in running] == [0, 0, 0]
    for lines in outputs:
        times = [round(16000 * float(line.split()[0])) for line in lines]
        assert times == sorted(times)
        assert {frame.media_time for frame in collected.frames} <= {*times}


def test_the_csharp_program_follows_through_the_gateway(system: System, tmp_path: Path) -> None:
    program = tmp_path / "follow.exe"
    subprocess.run(["mcs", f"-out:{program}", FOLDER / "Follow.cs", STREAM], check=True)
    gateway = Gateway(system.control, free_port())
    address = gateway.page.replace("http", "ws").rstrip("/")
    name = "followed-by-c-sharp"
    try:
        with (
            Client(system.control) as client,
            subprocess.Popen(
                ["mono", program, name, address], stdout=subprocess.PIPE, text=True
            ) as running,
        ):
            try:
                jaw = open_jaw(client, name, running)
            finally:
                running.terminate()
    finally:
        assert gateway.stop() == 0
    assert 0.2 < jaw <= 1


def open_jaw(client: Client, name: str, follower: subprocess.Popen[str]) -> float:
    """Speak until the program prints that the jaw is open; return the opening."""
    assert follower.stdout is not None
    assert follower.stdout.readline() == "0.00\n", "a face at rest"
    session = client.open_session(name=name, encoding="f32le", paced=False)
    samples = samples_of_file(VOWELS_FILE)
    jaw = 0.0
    while jaw <= 0.2:
        session.push(samples[:1600])
        samples = np.roll(samples, -1600)
        jaw = float(follower.stdout.readline())
    session.close()
    return jaw
