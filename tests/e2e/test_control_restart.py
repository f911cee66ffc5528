"""Nobody notices that control was killed and started again while a session runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kouxing_client import Client

from kouxing.shared.face.shapes import ARKIT, VRM
from tests.e2e.following import KINDS, Collected, finish, samples_of_file, send
from tests.system import DEMO, System

pytestmark = pytest.mark.e2e
SERVICES = ("control", "recognizer", "synthesizer", "driver")


def test_a_session_goes_on_while_control_is_killed_and_started_again(tmp_path: Path) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:64000]
    with System(SERVICES, tmp_path) as system, Client(system.control, timeout_s=60.0) as client:
        session = client.open_session(encoding="f32le", shapes=["vrm"])
        opened = session.info
        output = session.results(*KINDS, keep_all=True)
        collected = Collected()
        send(session, samples[:16000], output, collected, paced=True)
        client.set_face(session.name, expressiveness=1.8, shapes=["arkit"])
        killed = system.processes.pop("control")
        killed.kill()
        killed.wait()
        send(session, samples[16000:32000], output, collected, paced=True)
        system.start("control")
        session.set_face(expressions={"joy": 0.5})  # asked before control knows the session
        send(session, samples[32000:40000], output, collected, paced=True)
        assert session.info == opened, "it has not moved"
        (state,) = client.status().sessions
        assert (state.session, state.state) == (session.name, "open")
        provided = {"audio", "unpaced_audio", "phones", "phone_input", "faps"}
        assert {*state.workers} == provided

        system.start_beside("synthesizer", "other")
        lost = system.processes.pop("synthesizer")
        lost.kill()
        lost.wait()
        send(session, samples[40000:], output, collected, paced=True)
        finish(session, output, collected)
        assert session.info["epoch"] == 2, "the new control tells the client that it has moved"
        session.flush()
        session.close()
        assert not client.status().sessions
        system.assert_all_alive()

    frames = {(frame.epoch, frame.sequence): frame for frame in collected.frames}
    newest = max(place for place in frames if place[0] == 1)  # of the one that was killed
    for name, shapes in (("vrm", VRM), ("arkit", ARKIT)):
        published = {
            place: frame.shapes[name] for place, frame in frames.items() if name in frame.shapes
        }
        assert {epoch for epoch, _ in published} == {1, 2}
        expected = [place for place in frames if place >= min(published)]
        assert [*published] in (expected, [place for place in expected if place != newest])
        for place, weights in published.items():
            expected_weights = shapes.weights(np.frombuffer(frames[place].values, "<f4"))
            np.testing.assert_array_equal(np.frombuffer(weights, "<f4"), expected_weights)
    before = [frame for frame in collected.frames if frame.epoch == 1]
    assert [frame.sequence for frame in before] == [*range(1, len(before) + 1)]
    sounds = [sound for sound in collected.sounds if sound.epoch == 1]
    ends = [sound.media_time + len(sound.pcm) // 2 for sound in sounds]
    assert [sound.media_time for sound in sounds] == [0, *ends[:-1]]
    assert ends[-1] >= 40000
    assert "taken over" in system.log("control")
