"""The programs in examples/subscribe follow a session."""

import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Client

from tests.e2e.following import Stream, samples_of_file
from tests.system import NODE, ROOT, VOWELS_FILE, System, free_port

FOLDER = ROOT / "examples" / "subscribe"
STREAM = ROOT / "examples" / "unity" / "KouxingStream.cs"
SAMPLES = samples_of_file(VOWELS_FILE)


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
        [str(NODE), str(tmp_path / "follow.mjs")],
        [str(program)],
    ]


@pytest.fixture
def client(tmp_path: Path, programs: list[list[str]]) -> list[str]:
    """The command of the program that streams a file."""
    shutil.copy(ROOT / "examples" / "stream" / "client.mjs", tmp_path)
    return [str(NODE), str(tmp_path / "client.mjs")]


@pytest.mark.parametrize("wav", ["stereo 24", "float 48k"])
def test_the_client_streams_wav_files(
    system: System, tmp_path: Path, client: list[str], wav: str
) -> None:
    samples, rate_hz, form = {
        "stereo 24": (np.stack([SAMPLES, SAMPLES], axis=1), 16000, "PCM_24"),
        "float 48k": (np.repeat(SAMPLES, 3), 48000, "FLOAT"),
    }[wav]
    soundfile.write(tmp_path / "said.wav", samples, rate_hz, form, format="WAVEX")
    arguments = [*client, str(tmp_path / "said.wav"), system.control.partition(" ")[0]]
    output = subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True).stdout
    jaw = [float(line.split()[-1]) for line in output.splitlines()]
    assert len(jaw) == pytest.approx(50 * len(samples) / rate_hz, abs=50)
    assert max(jaw) - min(jaw) > 100


def test_without_a_server_each_program_prints_one_line(
    programs: list[list[str]], client: list[str]
) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    assistant = [sys.executable, str(ROOT / "examples" / "voice-assistant" / "assistant.py")]
    running = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for command in [
            *([*program, "", address] for program in programs),
            [*client, str(VOWELS_FILE), address],
            [*assistant, address.replace("tcp", "ws")],
        ]
    ]
    for process in running:
        (line,) = process.communicate(timeout=60)[1].splitlines()
        assert "kouxing run" in line
        assert process.returncode == 1


def test_follow_a_session_that_moves_to_its_end(system: System, programs: list[list[str]]) -> None:
    with (
        Client(system.control) as client,
        client.open_session(encoding="f32le") as session,
        ExitStack() as stack,
    ):
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
        sent = Stream(session)
        sent.send(SAMPLES[:16000], paced=True)
        system.add("synthesizer-2")
        system.lose("synthesizer").wait()
        sent.send(SAMPLES[16000:], paced=True)
        sent.finish()
        assert session.info["epoch"] > 1
        outputs = [process.communicate(timeout=60)[0].splitlines() for process in running]
    assert [process.returncode for process in running] == [0, 0, 0]
    for lines in outputs:
        times_s, jaw = zip(*(map(float, line.split()) for line in lines), strict=True)
        times = [round(16000 * time_s) for time_s in times_s]
        assert times == sorted(times)
        assert {*sent.times} <= {*times}
        assert 0.2 < max(jaw) <= 1, "/a/ must open the jaw"
        assert min(jaw) == 0


def test_the_csharp_program_follows_through_the_gateway(system: System, tmp_path: Path) -> None:
    program = tmp_path / "follow.exe"
    subprocess.run(["mcs", f"-out:{program}", FOLDER / "Follow.cs", STREAM], check=True)
    address = system.page.replace("http", "ws").rstrip("/")
    name, jaw, samples = "followed-by-c-sharp", 0.0, SAMPLES
    with (
        Client(system.control) as client,
        subprocess.Popen(
            ["mono", program, name, address], stdout=subprocess.PIPE, text=True
        ) as follower,
    ):
        assert follower.stdout is not None
        assert follower.stdout.readline() == "0.00\n", "a face at rest"
        with client.open_session(name, encoding="f32le", paced=False) as session:
            while jaw <= 0.2:
                session.push(samples[:1600])
                samples = np.roll(samples, -1600)
                jaw = float(follower.stdout.readline())
        follower.terminate()
    assert jaw <= 1
