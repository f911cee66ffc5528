"""Strangers that know only PROTOCOL.md."""

import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import msgpack
import zmq
from kouxing_client.keys import Key

from kouxing.evaluation.system.attackers import connect
from kouxing.shared.keys import key_folder, load_key, user_key
from tests.documents import code_blocks
from tests.e2e.following import samples_of_file, stream
from tests.system import ROOT, VOWELS_FILE, System

EXAMPLES = ROOT / "examples" / "stream"
KEY_FILE = "~/.local/state/kouxing/client.key"


class Stranger:
    """A program that speaks the protocol with nothing but pyzmq and msgpack."""

    def __init__(self) -> None:
        self.context = zmq.Context()

    def socket(self, kind: int, endpoint: str, key: Key | None = None) -> zmq.Socket[bytes]:
        made = self.context.socket(kind)
        made.setsockopt(zmq.LINGER, 1000)
        made.setsockopt(zmq.RCVTIMEO, 60000)
        connect(made, endpoint, key or user_key())
        return made

    def close(self) -> None:
        self.context.destroy()


def send(socket: zmq.Socket[bytes], kind: str, session: str, **fields: object) -> None:
    body = {"version": 3, "session": session, **fields}
    socket.send_multipart([f"{kind}/{session}/".encode(), msgpack.packb(body)])


def receive(socket: zmq.Socket[bytes]) -> tuple[str, dict[str, Any]]:
    topic, body = socket.recv_multipart()
    return topic.decode().split("/")[0], msgpack.unpackb(body)


def test_a_stranger_streams_audio_and_another_reads_the_faps(system: System) -> None:
    speaker, watcher = Stranger(), Stranger()
    control = speaker.socket(zmq.DEALER, system.control)
    send(control, "open-session", "stranger", request="1", encoding="s16le", paced=False)
    kind, opened = receive(control)
    assert kind == "session-opened", opened
    faps = watcher.socket(zmq.SUB, opened["faps"])
    for wanted in ("fap-frame", "end-of-faps", "joined"):
        faps.setsockopt(zmq.SUBSCRIBE, f"{wanted}/stranger/".encode())
    assert receive(faps)[0] == "joined"

    samples = samples_of_file(VOWELS_FILE)
    pcm = (samples * 32767).astype("<i2").tobytes()
    audio = speaker.socket(zmq.DEALER, opened["audio"])
    for number, begin in enumerate(range(0, len(pcm), 1280), start=1):
        send(
            audio,
            "audio-chunk",
            "stranger",
            token=opened["token"],
            sequence=number,
            media_time=begin // 2,
            pcm=pcm[begin : begin + 1280],
        )
    send(audio, "audio-chunk", "stranger", token=opened["token"], sequence=10**6, last=True)

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

    send(control, "close-session", "stranger", request="2", token=opened["token"])
    assert receive(control)[0] == "done"
    speaker.close()
    watcher.close()


def test_an_observer_of_a_kind_that_control_does_not_know_takes_part(system: System) -> None:
    stranger = Stranger()
    lamp = stranger.socket(zmq.DEALER, system.control, load_key("lamp", ("service:lamp",)))
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

    client = stranger.socket(zmq.DEALER, system.control)
    send(client, "open-session", "lit", request="1", paced=False)
    kind, start = receive(lamp)
    assert kind == "start-session"
    assert "faps" in start["endpoints"]
    assert not client.poll(300), "the session opens once the lamp is ready for it"
    send(lamp, "session-started", "lit", request=start["request"])
    _, opened = receive(client)
    facts = opened["facts"]
    assert (facts["language"], facts["frame_rate_hz"]) == ("mandarin", 50.0)

    send(client, "status-request", "", request="2")
    _, report = receive(client)
    roles = {service["service"]: service["role"] for service in report["services"]}
    assert roles["lamp"] == roles["driver"] == "observer"
    assert roles["recognizer"] == roles["synthesizer"] == "worker"

    send(client, "close-session", "lit", request="3", token=opened["token"])
    assert receive(lamp)[0] == "close-session"
    send(lamp, "heartbeat", "", **{**heartbeat, "state": "draining"})
    assert receive(lamp)[0] == "heartbeat-reply"
    stranger.close()


def test_a_client_of_another_version_is_answered_in_its_version(system: System) -> None:
    stranger = Stranger()
    control = stranger.socket(zmq.DEALER, system.control)
    control.send_multipart([b"open//", msgpack.packb({"version": 1, "request": "r"})])
    kind, answer = receive(control)
    assert (kind, answer["version"], answer["code"]) == ("error", 1, "bad-message")
    assert "upgrade" in answer["text"]
    stranger.close()


def test_the_example_in_the_readme_follows_a_face(system: System, tmp_path: Path) -> None:
    (example,) = code_blocks(ROOT / "README.md", "python")
    faps = system.endpoints()["faps"].partition(" ")[0]
    for default, own in (
        ("tcp://127.0.0.1:5571", faps),
        (str(Path(KEY_FILE).parent), key_folder()),
    ):
        assert default in example
        example = example.replace(default, str(own))
    command = [sys.executable, "-u", "-c", example]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        heard = threading.Thread(target=program.stdout.readline)
        heard.start()
        while heard.is_alive():  # it subscribes at some time
            stream(system.control, samples_of_file(VOWELS_FILE)[:8000], session="demo")
        assert program.poll() is None
        program.terminate()
