"""A face whose synthesizer is lost: whoever follows it sees every frame once, and no jump."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq
from kouxing_client import Client
from numpy.typing import NDArray

from kouxing.evaluation.system.attackers import connect
from kouxing.shared.keys import user_key
from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send, stream
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
LARGEST_STEP = 1.2  # times the largest one undisturbed
UNSEEN = 1.0  # FAP units; a smaller step is none
SETTINGS = {"KOUXING_CONTROL_LOST_AFTER_S": "1"}


class Stranger:
    """Follows a session through its moves with nothing but pyzmq and PROTOCOL.md."""

    def __init__(self, session: str, faps: str, events: str) -> None:
        self.frames: dict[int, NDArray[np.float32]] = {}  # by media time
        self._session = session
        self._epoch = 0
        self._newest = (-1, -1)
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        connect(self._socket, faps, user_key())
        for kind in ("fap-frame", "end-of-faps", "joined"):
            self._socket.subscribe(f"{kind}/{session}/")
        connect(self._socket, events, user_key())
        self._socket.subscribe(f"session-moved/{session}/")
        while self._receive() != "joined":
            pass

    def follow_to_the_end(self) -> None:
        while self._receive() != "end-of-faps":
            pass
        self._context.destroy()

    def _receive(self) -> str:
        """Take a message; return its kind, empty if it is dropped."""
        assert self._socket.poll(60_000)
        topic, body = self._socket.recv_multipart()
        kind, message = topic.decode().split("/")[0], msgpack.unpackb(body)
        if kind == "session-moved":
            connect(self._socket, message["faps"], user_key())
            self._socket.unsubscribe(f"joined/{self._session}/")  # ask anew, of all
            self._socket.subscribe(f"joined/{self._session}/")
        if message["epoch"] < self._epoch:
            return ""
        place = (message["media_time"], message["sequence"])
        if kind == "fap-frame" and place > self._newest:
            self._epoch, self._newest = message["epoch"], place
            self.frames[message["media_time"]] = np.frombuffer(message["values"], "<f4")
        return str(kind)


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_whoever_follows_sees_every_frame_once(tmp_path: Path, blow: signal.Signals) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:72000]
    services = ("control", "recognizer", "synthesizer")
    with System(services, tmp_path, settings=SETTINGS) as system, Client(system.control) as client:
        undisturbed = stream(system.control, samples)
        system.start_beside("synthesizer", "other")
        session = client.open_session(encoding="f32le")
        place = next(each for each in client.status().sessions if each.session == session.name)
        lost = system.processes["other" if place.workers["faps"] == "other" else "synthesizer"]
        stranger = Stranger(session.name, session.info["faps"], session.info["events"])
        following = threading.Thread(target=stranger.follow_to_the_end)
        following.start()
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:32000], output, collected, paced=True)
        lost.send_signal(blow)
        send(session, samples[32000:64000], output, collected, paced=True)
        lost.send_signal(signal.SIGCONT)  # it may speak once more, to nobody
        send(session, samples[64000:], output, collected, paced=True)
        finish(session, output, collected)
        following.join()
        session.close()

    times = [frame.media_time for frame in undisturbed.frames]
    assert session.info["epoch"] > 1
    spoken = [frame for frame in collected.frames if frame.media_time in set(times)]
    assert sorted({frame.media_time for frame in spoken}) == times
    assert list(stranger.frames) == times
    usual = np.maximum(np.abs(np.diff(undisturbed.faps, axis=0)).max(axis=0), UNSEEN)
    for faps in (collected.faps, np.array(list(stranger.frames.values()))):
        assert (np.abs(np.diff(faps, axis=0)).max(axis=0) <= LARGEST_STEP * usual).all()
    epochs = [frame.epoch for frame in collected.frames]
    assert epochs == sorted(epochs)
