"""A session continues while control is killed and started again."""

from pathlib import Path

import numpy as np
from kouxing_client import Client

from kouxing.shared.face.shapes import ARKIT, VRM
from tests.e2e.streaming import StreamedSession
from tests.system import CHAIN, DEMO, System, samples_of_file


def test_a_session_continues_while_control_is_killed_and_started_again(tmp_path: Path) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")[:56000]
    with (
        System((*CHAIN, "driver"), tmp_path, {"KOUXING_CONTROL_INSTANCE": "control"}) as system,
        Client(system.control, timeout_s=60.0) as client,
    ):
        session = client.open_session(encoding="f32le", shapes=["vrm"])
        opened = session.info
        streamed = StreamedSession(session)
        streamed.send(samples[:16000], paced=True)
        client.set_face(session.name, expressiveness=1.8, shapes=["arkit"])
        system.process("control").kill()
        system.process("control").wait()
        streamed.send(samples[16000:32000], paced=True)
        system.start("control")
        session.set_face(expressions={"joy": 0.5})  # before control knows the session
        streamed.send(samples[32000:40000], paced=True)
        assert session.info == opened, "it has not moved"
        (state,) = client.status().sessions
        assert (state.session, state.state) == (session.name, "open")
        assert {*state.workers} == {"audio", "unpaced_audio", "phones", "phone_input", "faps"}

        system.add("synthesizer-2")
        system.lose("synthesizer").wait()
        streamed.send(samples[40000:], paced=True)
        streamed.finish()
        assert session.info["epoch"] == 2, "the new control reports the move to the client"
        session.close()
        assert not client.status().sessions
        system.assert_all_alive()
        assert "session restored" in system.log("control")

    frames = {(frame.epoch, frame.sequence): frame for frame in streamed.frames}
    newest = max(place for place in frames if place[0] == 1)  # of the killed synthesizer
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
    sounds = [sound for sound in streamed.sounds if sound.epoch == 1]
    ends = [sound.media_time + len(sound.pcm) // 2 for sound in sounds]
    assert [sound.media_time for sound in sounds] == [0, *ends[:-1]]
    assert ends[-1] >= 39680  # the sound of the last 20 ms is published with the next sound
