"""Bad input of every kind: a clear answer, no service dies, other sessions go on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from kouxing_client import Client, Refused, Session, Sound

from kouxing.shared.bus import Bus
from kouxing.shared.keys import load_key
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.control import Heartbeat, SessionInput
from kouxing.shared.wire.session import Error
from kouxing.shared.wire.speech import Acknowledge
from tests.e2e.following import stream
from tests.system import System

pytestmark = pytest.mark.e2e


def answers(socket: Socket, deadline_s: float = 60.0) -> Iterator[Error]:
    end_s = time.monotonic() + deadline_s
    while time.monotonic() < end_s:
        socket.wait(0.1)
        for received in socket.receive():
            if isinstance(received.message, Error):
                yield received.message


def first_error(session: Session) -> Refused:
    end_s = time.monotonic() + 60
    while time.monotonic() < end_s:
        for error in session.take_errors():
            return error
        time.sleep(0.02)
    raise AssertionError("no error came")


def test_nan_is_refused_and_the_session_goes_on(client: Client, witness: Session) -> None:
    session = client.open_session(encoding="f32le")
    session.push(np.array([0.0, np.nan, 0.0], np.float32))
    assert first_error(session).code == "bad-audio"
    output = session.frames()
    session.push(np.zeros(8000, np.float32))
    assert output.get(60.0) is not None
    session.close()


def test_empty_chunks_and_silence_and_clipping_are_taken(client: Client, witness: Session) -> None:
    session = client.open_session(encoding="f32le", paced=False)
    output = session.frames()
    session.push(np.zeros(0, np.float32))
    session.push(np.zeros(8000, np.float32))
    session.push(np.full(8000, 1e9, np.float32))
    end_s = time.monotonic() + 60
    newest = -1
    while newest < 12000:
        assert time.monotonic() < end_s
        for frame in output.available(0.1):
            assert np.isfinite(frame.values).all()
            newest = frame.media_time
    assert session.take_errors() == []
    session.close()


def test_an_unknown_session_is_named(
    system: System, client: Client, bus: Bus, witness: Session
) -> None:
    audio = bus.connect_dealer(witness.info["audio"])
    audio.send(AudioChunk(session="nobody", token="t", sequence=1, pcm=b""))
    error = next(answers(audio))
    assert (error.code, error.session) == ("unknown-session", "nobody")
    with pytest.raises(Refused, match="nobody") as caught:
        client.request("close-session", "nobody", token="t")
    assert caught.value.code == "unknown-session"


def test_a_foreign_token_is_refused_and_a_replay_dropped(
    client: Client, bus: Bus, witness: Session
) -> None:
    thief = bus.connect_dealer(witness.info["audio"])
    thief.send(AudioChunk(session=witness.name, token="guess", sequence=1, pcm=b""))
    thief.send(AudioChunk(session=witness.name, token="guess", sequence=2, last=True))
    codes = answers(thief)
    assert [next(codes).code, next(codes).code] == ["bad-token", "bad-token"]
    with pytest.raises(Refused) as caught:
        client.request("close-session", witness.name, token="guess")
    assert caught.value.code == "bad-token"
    token = witness.info["token"]
    output = witness.results(Sound)
    witness.push(np.zeros(320, np.float32))
    assert list(output.available(60.0))
    replay = AudioChunk(session=witness.name, token=token, sequence=1, pcm=bytes(1280))
    thief.send(replace(replay, acknowledge=True))
    assert thief.wait(60.0)
    (answer,) = thief.receive()
    assert isinstance(answer.message, Acknowledge)
    assert answer.message.sequence == 1
    assert output.get(0.2) is None


def test_a_jump_of_years_in_media_time_makes_no_frames_for_them(
    client: Client, bus: Bus, witness: Session
) -> None:
    session = client.open_session(encoding="f32le", paced=False)
    output = session.frames()
    audio = bus.connect_dealer(session.info["audio"])
    later = 2**39
    pcm = np.zeros(8000, "<f4").tobytes()
    for sequence, media_time in ((1, 0), (2, later)):
        audio.send(
            AudioChunk(
                session=session.name,
                token=session.info["token"],
                sequence=sequence,
                media_time=media_time,
                pcm=pcm,
            )
        )
    times: list[int] = []
    end_s = time.monotonic() + 60
    while not times or times[-1] < later:
        assert time.monotonic() < end_s
        times += [frame.media_time for frame in output.available(0.1)]
    assert len(times) < 100
    session.close()


@pytest.mark.parametrize(
    "endpoints",
    [
        {},
        {"audio": "x", "phones": "y"},
        {"audio": "tcp://*:1", "phones": "tcp://*:2"},
        {"audio": "tcp://-:1", "phones": "tcp://-:1"},
    ],
)
def test_a_false_recognizer_is_not_given_sessions(
    system: System, client: Client, witness: Session, endpoints: dict[str, str]
) -> None:
    with Bus(load_key("recognizer", ())) as bus:
        stranger = bus.connect_dealer(system.control)
        stranger.send(
            Heartbeat(
                service="recognizer",
                instance="a-false-one",
                role="worker",
                state="ready",
                sent_ns=0,
                endpoints=endpoints,
                sessions={witness.name: SessionInput(idle_s=1e9)},
            )
        )
        assert next(answers(stranger)).code == "bad-message"
    assert "a-false-one" not in {state.instance for state in client.status().services}


def test_an_observer_that_never_answers_delays_no_session(
    system: System, client: Client, witness: Session
) -> None:
    with Bus(load_key("gateway", ("service:gateway",))) as bus:
        mute = bus.connect_dealer(system.control)
        heartbeat = Heartbeat(
            service="gateway", instance="mute", role="observer", state="ready", sent_ns=0
        )
        mute.send(heartbeat)
        assert mute.wait(60.0), "control knows it"
        client.open_session(encoding="f32le").close()
        mute.send(replace(heartbeat, state="draining"))


def test_a_client_that_goes_away_leaves_no_trace(system: System, witness: Session) -> None:
    with Client(system.control) as vanishing:
        vanishing.open_session(name="ghost", encoding="f32le").push(np.zeros(320, np.float32))
    assert stream(system.control, np.zeros(3200, np.float32)).frames
