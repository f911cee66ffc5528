"""Programs that know only PROTOCOL.md: independent ones, and the examples."""

import os
import shutil
import struct
import subprocess
import sys
import threading
from collections.abc import Collection
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import soundfile
import zmq
from kouxing_client import Client
from kouxing_client.keys import Key
from kouxing_client.messages import EndOfFaps, Event, SessionState

from kouxing.evaluation.system.attackers import connect
from kouxing.shared.fast_record import replace
from kouxing.shared.settings.endpoints import with_key
from kouxing.shared.settings.keys import load_key, load_user_key
from kouxing.shared.wire.session import SessionMoved, StatusReport, StatusRequest
from tests.documents import code_blocks
from tests.e2e.streaming import StreamedSession
from tests.fake_control import FACTS, FakeControl
from tests.system import (
    CHAIN,
    LIMIT_S,
    NODE,
    ROOT,
    VOWELS_FILE,
    Gateway,
    System,
    free_port,
    samples_of_file,
)


@pytest.fixture(scope="module")
def services() -> Collection[str]:
    return (*CHAIN, "gateway")


class IndependentProgram:
    """A program that implements the protocol with pyzmq and msgpack."""

    def __init__(self) -> None:
        self.context = zmq.Context()

    def socket(self, kind: int, endpoint: str, key: Key | None = None) -> zmq.Socket[bytes]:
        new_socket = self.context.socket(kind)
        new_socket.setsockopt(zmq.LINGER, 1000)
        new_socket.setsockopt(zmq.RCVTIMEO, 60000)
        connect(new_socket, endpoint, key or load_user_key())
        return new_socket

    def close(self) -> None:
        self.context.destroy()


def send(socket: zmq.Socket[bytes], kind: str, session: str, **fields: object) -> None:
    body = {"version": 3, "session": session, **fields}
    socket.send_multipart([f"{kind}/{session}/".encode(), msgpack.packb(body)])


def receive(socket: zmq.Socket[bytes]) -> tuple[str, dict[str, Any]]:
    topic, body = socket.recv_multipart()
    return topic.decode().split("/")[0], msgpack.unpackb(body)


def test_one_program_streams_audio_and_another_receives_the_faps(system: System) -> None:
    speaker, watcher = IndependentProgram(), IndependentProgram()
    control = speaker.socket(zmq.DEALER, system.control)
    send(control, "open-session", "independent", request="1", encoding="s16le", paced=False)
    kind, opened = receive(control)
    assert kind == "session-opened", opened
    faps = watcher.socket(zmq.SUB, opened["faps"])
    for wanted in ("fap-frame", "end-of-faps", "joined"):
        faps.setsockopt(zmq.SUBSCRIBE, f"{wanted}/independent/".encode())
    assert receive(faps)[0] == "joined"

    samples = samples_of_file(VOWELS_FILE)
    pcm = (samples * 32767).astype("<i2").tobytes()
    audio = speaker.socket(zmq.DEALER, opened["audio"])
    for number, begin in enumerate(range(0, len(pcm), 1280), start=1):
        send(
            audio,
            "audio-chunk",
            "independent",
            token=opened["token"],
            sequence=number,
            media_time=begin // 2,
            pcm=pcm[begin : begin + 1280],
        )
    send(audio, "audio-chunk", "independent", token=opened["token"], sequence=10**6, last=True)

    jaw: list[float] = []
    while (frame := receive(faps))[0] != "end-of-faps":
        kind, body = frame
        assert kind == "fap-frame"
        assert body["mask"] == bytes([252] + [255] * 7 + [15])
        assert body["media_time"] == 320 * len(jaw)
        jaw.append(struct.unpack("<68f", body["values"])[2])
    assert len(jaw) / 50 >= len(samples) / 16000
    assert max(jaw) > 200, "/a/ opens the jaw"
    assert abs(jaw[-1]) < 1

    send(control, "close-session", "independent", request="2", token=opened["token"])
    assert receive(control)[0] == "done"
    speaker.close()
    watcher.close()


def test_an_observer_of_an_unknown_kind_takes_part(system: System) -> None:
    program = IndependentProgram()
    lamp = program.socket(zmq.DEALER, system.control, load_key("lamp", ("service:lamp",)))
    heartbeat: dict[str, Any] = {
        "service": "lamp",
        "instance": "lamp-1",
        "role": "observer",
        "state": "ready",
        "sent_ns": 0,
        "needs": ["faps"],
    }
    send(lamp, "heartbeat", "", **heartbeat)
    assert receive(lamp)[0] == "heartbeat-reply"

    client = program.socket(zmq.DEALER, system.control)
    send(client, "open-session", "lit", request="1", paced=False)
    kind, start = receive(lamp)
    assert kind == "start-session"
    assert "faps" in start["endpoints"]
    send(client, "status-request", "", request="2")
    assert receive(client)[0] == "status-report", "the session opens once the lamp is ready for it"
    send(lamp, "session-started", "lit", request=start["request"])
    _, opened = receive(client)
    facts = opened["facts"]
    assert (facts["language"], facts["frame_rate_hz"]) == ("mandarin", 50.0)

    send(client, "status-request", "", request="2")
    _, report = receive(client)
    roles = {service["service"]: service["role"] for service in report["services"]}
    assert roles["lamp"] == roles["gateway"] == "observer"
    assert roles["recognizer"] == roles["synthesizer"] == "worker"

    send(client, "close-session", "lit", request="3", token=opened["token"])
    assert receive(lamp)[0] == "close-session"
    send(lamp, "heartbeat", "", **{**heartbeat, "state": "draining"})
    assert receive(lamp)[0] == "heartbeat-reply"
    program.close()


def test_a_client_of_another_version_is_answered_in_its_version(system: System) -> None:
    program = IndependentProgram()
    control = program.socket(zmq.DEALER, system.control)
    control.send_multipart([b"open//", msgpack.packb({"version": 1, "request": "r"})])
    kind, answer = receive(control)
    assert (kind, answer["version"], answer["code"]) == ("error", 1, "bad-message")
    assert answer["request"] == "r"
    assert "upgrade" in answer["text"]
    program.close()


def test_the_example_in_the_readme_follows_a_face(system: System) -> None:
    (example,) = code_blocks(ROOT / "README.md", "python")
    command = [sys.executable, "-u", "-c", example]
    environment = {**os.environ, "KOUXING_CONTROL": system.control.partition(" ")[0]}
    samples = samples_of_file(VOWELS_FILE)[:1600]
    with (
        Client(system.control) as client,
        client.open_session("demo", encoding="f32le", paced=False) as session,
        subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as program,
    ):
        assert program.stdout is not None
        first_line = threading.Thread(target=program.stdout.readline)
        first_line.start()
        while first_line.is_alive():  # until the program has subscribed
            session.push(samples)
        session.finish()
        program.stdout.read()
        assert program.wait(LIMIT_S) == 0


FOLDER = ROOT / "examples" / "subscribe"
STREAM = ROOT / "examples" / "unity" / "KouxingStream.cs"
ASSISTANT = [sys.executable, str(ROOT / "examples" / "voice-assistant" / "assistant.py")]
SAMPLES = samples_of_file(VOWELS_FILE)


@pytest.fixture
def programs(tmp_path: Path) -> list[list[str]]:
    """The commands of the programs."""
    node = ROOT / "examples" / "node"
    for script in node.glob("*.mjs"):
        shutil.copy(script, tmp_path)
    (tmp_path / "node_modules").symlink_to(node / "node_modules")
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
    return [str(NODE), str(tmp_path / "stream.mjs")]


@pytest.mark.parametrize("wav", ["stereo 24", "float 48k", "long"])
def test_the_client_streams_wav_files(
    system: System, tmp_path: Path, client: list[str], wav: str
) -> None:
    samples, rate_hz, form = {
        "stereo 24": (np.stack([SAMPLES, SAMPLES], axis=1), 16000, "PCM_24"),
        "float 48k": (np.repeat(SAMPLES, 3), 48000, "FLOAT"),
        "long": (np.tile(SAMPLES, 8), 16000, "PCM_16"),  # memory is freed while it is spoken
    }[wav]
    soundfile.write(tmp_path / "said.wav", samples, rate_hz, form, format="WAVEX")
    arguments = [*client, str(tmp_path / "said.wav"), system.control.partition(" ")[0]]
    output = subprocess.run(arguments, check=True, stdout=subprocess.PIPE, text=True).stdout
    jaw = [float(line.split()[-1]) for line in output.splitlines()]
    assert len(jaw) == pytest.approx(50 * len(samples) / rate_hz, abs=50)
    assert max(jaw) - min(jaw) > 100


def test_the_client_ends_if_its_audio_is_rejected(
    system: System, tmp_path: Path, client: list[str]
) -> None:
    samples = np.full(16000, np.nan, np.float32)
    soundfile.write(tmp_path / "broken.wav", samples, 16000, "FLOAT")
    arguments = [*client, str(tmp_path / "broken.wav"), system.control.partition(" ")[0]]
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, text=True) as program:
        assert "NaN" in program.communicate(timeout=LIMIT_S)[1]
    assert program.returncode == 1


def test_without_a_server_each_program_prints_one_line(
    programs: list[list[str]], client: list[str]
) -> None:
    load_user_key()  # creates it, if no system has started
    address = f"tcp://127.0.0.1:{free_port()}"
    running = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for command in [
            *([*program, "", address] for program in programs),
            [*client, str(VOWELS_FILE), address],
            [*ASSISTANT, address.replace("tcp", "ws")],
        ]
    ]
    for process in running:
        (line,) = process.communicate(timeout=60)[1].splitlines()
        assert "kouxing run" in line
        assert process.returncode == 1


def test_the_assistant_reports_a_certificate_that_is_not_trusted(tmp_path: Path) -> None:
    with FakeControl() as control:
        gateway = Gateway(control.address, https=str(tmp_path / "kouxing.pem"))
        command = [*ASSISTANT, gateway.page.replace("https", "wss")]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as assistant:
            (line,) = assistant.communicate(timeout=LIMIT_S)[1].splitlines()
        assert "is not trusted; set SSL_CERT_FILE" in line
        assert gateway.stop() == 0


def test_follow_a_session_that_moves_to_its_end(
    system: System, programs: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KOUXING_CONTROL", system.control.partition(" ")[0])
    with (
        Client(system.control) as client,
        client.open_session(encoding="f32le") as session,
        ExitStack() as stack,
    ):
        running = [
            stack.enter_context(
                subprocess.Popen([*program, session.name], stdout=subprocess.PIPE, text=True)
            )
            for program in programs
        ]
        for process in running:
            assert process.stdout is not None
            assert process.stdout.readline() == f"following {session.name}\n"
        streamed = StreamedSession(session)
        streamed.send(SAMPLES[:16000], paced=True)
        system.add("synthesizer-2")
        system.lose("synthesizer").wait()
        streamed.send(SAMPLES[16000:], paced=True)
        streamed.finish()
        assert session.info["epoch"] > 1
        outputs = []
        for process in running:
            assert process.stdout is not None
            outputs.append(process.stdout.read().splitlines())  # not communicate, after readline
            process.wait()
    assert [process.returncode for process in running] == [0, 0, 0]
    for lines in outputs:
        times_s, jaw = zip(*(map(float, line.split()) for line in lines), strict=True)
        times = [round(16000 * time_s) for time_s in times_s]
        assert times == sorted(times)
        assert {*streamed.times} <= {*times}
        assert 0.2 < max(jaw) <= 1, "/a/ must open the jaw"
        assert min(jaw) == 0


class NamesakeControl(FakeControl):
    """Control of a session whose name an earlier session had; faps also publishes its events."""

    def __init__(self) -> None:
        self.key = load_key("control", ())
        load_user_key()  # creates it
        super().__init__(self.key)

    def _status(self, request: StatusRequest) -> StatusReport:
        faps = with_key(self.faps.endpoint, self.key.public)
        state = SessionState(
            session="s",
            session_id="new",
            state="open",
            age_s=0,
            speaking=False,
            endpoints={"faps": faps},
            workers={},
            facts=FACTS,
        )
        report = super()._status(request)
        control = replace(report.services[0], service="control", endpoints={"events": faps})
        return replace(report, services=[control], sessions=[state])


@pytest.mark.usefixtures("new_keys")
def test_the_c_program_ignores_the_move_of_an_earlier_session(programs: list[list[str]]) -> None:
    with NamesakeControl() as control:
        elsewhere = with_key("tcp://127.0.0.1:1", control.key.public)
        moved = SessionMoved(
            session="s", session_id="old", epoch=9, audio="", phones="", faps=elsewhere
        )
        command = [*programs[-1], "s", control.address]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
            assert program.stdout is not None
            assert program.stdout.readline() == "following s\n"
            control.publish(control.faps, moved, EndOfFaps(session="s", epoch=1, sequence=1))
            try:
                assert program.wait(LIMIT_S) == 0
            finally:
                program.kill()


@pytest.mark.usefixtures("new_keys")
@pytest.mark.parametrize("number", [1, 2])
def test_a_program_ends_if_control_closes_the_session(
    programs: list[list[str]], number: int
) -> None:
    with NamesakeControl() as control:
        closed = Event(session="s", session_id="new", name="session-closed", detail="idle")
        command = [*programs[number], "s", control.address]
        pipe = subprocess.PIPE
        with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as program:
            assert program.stdout is not None
            assert program.stderr is not None
            assert program.stdout.readline() == "following s\n"
            control.publish(control.faps, replace(closed, session_id="old"))
            try:
                for _ in range(round(LIMIT_S)):  # until the subscription is in effect
                    control.publish(control.faps, closed)
                    with suppress(subprocess.TimeoutExpired):
                        program.wait(1.0)
                        break
            finally:
                program.kill()
            assert program.returncode == 1
            assert "control has closed the session" in program.stderr.read()


@pytest.fixture(scope="module")
def csharp_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    program = tmp_path_factory.mktemp("csharp") / "follow.exe"
    subprocess.run(["mcs", "--parse", *STREAM.parent.glob("*.cs")], check=True)
    subprocess.run(["mcs", f"-out:{program}", FOLDER / "Follow.cs", STREAM], check=True)
    return program


def test_the_csharp_program_follows_through_the_gateway(
    system: System, csharp_program: Path
) -> None:
    address = system.page.replace("http", "ws").rstrip("/")
    name, jaw, samples = "avatar", 0.0, SAMPLES  # also the type of a message
    with (
        Client(system.control) as client,
        subprocess.Popen(
            ["mono", csharp_program, name, address], stdout=subprocess.PIPE, text=True
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


def test_the_csharp_program_passes_the_token_to_the_gateway(csharp_program: Path) -> None:
    with FakeControl() as control:
        gateway = Gateway(control.address, token="a+secret")
        command: list[str | Path] = ["mono", csharp_program, "", gateway.page.replace("http", "ws")]
        for token, stream, text in (
            ("a+secret", "stdout", "0.00"),
            ("wrong", "stderr", "cannot connect to the gateway"),
        ):
            environment = {**os.environ, "KOUXING_GATEWAY_TOKEN": token}
            pipe: Any = {stream: subprocess.PIPE}
            with subprocess.Popen(command, env=environment, text=True, **pipe) as follower:
                assert text in getattr(follower, stream).readline()
                follower.terminate()
        assert gateway.stop() == 0
