"""``kouxing send`` with a running system."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys

import pytest
from kouxing_client import Client

from tests.e2e.following import samples_of_file, stream_into
from tests.receivers import read_osc
from tests.system import ROOT, VOWELS_FILE, System, kouxing

pytestmark = pytest.mark.e2e


def test_sends_every_session_of_a_name(system: System) -> None:
    samples = samples_of_file(VOWELS_FILE)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as program:
        program.bind(("127.0.0.1", 0))
        program.settimeout(60)
        url = f"osc://127.0.0.1:{program.getsockname()[1]}"
        sender = subprocess.Popen(
            [sys.executable, "-m", "kouxing", "send", url, "--session", "sent"],
            env={**os.environ, "KOUXING_CONTROL": system.control.partition(" ")[0]},
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert sender.stderr is not None
        assert f"sending ARKit shapes and head to {url}" in sender.stderr.readline()
        assert program.recv(2000)  # a face at rest
        with Client(system.control) as client:
            for _ in range(2):
                session = client.open_session(name="sent", encoding="f32le", paced=False)
                assert sender.stderr.readline() == "following session sent\n"
                stream_into(session, samples, chunk=320)
                while jaw_opening(program) < 0.1:
                    pass
                session.close()
                while jaw_opening(program) > 0.01:  # until the face is at rest
                    pass
        sender.send_signal(signal.SIGINT)
        assert sender.wait(60) == 0
        sender.stderr.close()


def jaw_opening(program: socket.socket) -> float:
    while True:
        messages = dict(read_osc([program.recv(2000)]))
        if "/kouxing/jawOpen" in messages:
            return float(messages["/kouxing/jawOpen"][0])


def test_rejects_a_wrong_address(system: System) -> None:
    result = kouxing("send", "http://127.0.0.1", control=system.control)
    assert result.returncode == 2
    assert "write vmc://HOST" in result.stderr
