"""Bad input of every kind: a clear answer, no service dies, and other sessions continue."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from kouxing_client import Client, Refused, Session, Sound

from kouxing.shared.bus import Bus
from kouxing.shared.keys import load_key
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.control import Heartbeat
from kouxing.shared.wire.session import Error
from kouxing.shared.wire.speech import Acknowledge
from tests.e2e.following import Stream
from tests.system import LIMIT_S, System, wait_until


def answers(socket: Socket) -> Iterator[Error]:
    while socket.wait(LIMIT_S):
        for received in socket.receive():
            if isinstance(received.message, Error):
                yield received.message


def test_rejects_nan_and_accepts_empty_chunks_silence_and_clipping(
    client: Client, witness: Session
) -> None:
    with client.open_session(encoding="f32le", paced=False) as session:
        sent = Stream(session)
        session.push(np.array([0.0, np.nan, 0.0], np.float32))
        errors: list[Refused] = []
        wait_until(lambda: errors, step=lambda: errors.extend(session.take_errors()))
        assert [error.code for error in errors] == ["bad-audio"]
        for samples in (np.zeros(0), np.zeros(8000), np.full(8000, 1e9)):
            session.push(samples.astype(np.float32))
        sent.finish()
    assert sent.times[-1] >= 16000
    assert np.isfinite(sent.faps).all()


def test_names_an_unknown_session(client: Client, bus: Bus, witness: Session) -> None:
    audio = bus.connect_dealer(witness.info["audio"])
    audio.send(AudioChunk(session="nobody", token="t", sequence=1, pcm=b""))
    error = next(answers(audio))
    assert (error.code, error.session) == ("unknown-session", "nobody")
    with pytest.raises(Refused, match="nobody") as caught:
        client.request("close-session", "nobody", token="t")
    assert caught.value.code == "unknown-session"


def test_rejects_a_foreign_token_and_drops_a_replay(
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
    assert list(output.available(LIMIT_S))
    replay = AudioChunk(session=witness.name, token=token, sequence=1, pcm=bytes(1280))
    thief.send(replace(replay, acknowledge=True))
    assert thief.wait(LIMIT_S)
    (answer,) = thief.receive()
    assert isinstance(answer.message, Acknowledge)
    assert answer.message.sequence == 1
    assert output.get(0.2) is None


def test_an_observer_that_never_answers_delays_no_session(system: System, client: Client) -> None:
    with Bus(load_key("gateway", ("service:gateway",))) as bus:
        mute = bus.connect_dealer(system.control)
        heartbeat = Heartbeat(
            service="gateway", instance="mute", role="observer", state="ready", sent_ns=0
        )
        mute.send(heartbeat)
        assert mute.wait(LIMIT_S), "control has registered it"
        client.open_session(encoding="f32le").close()
        mute.send(replace(heartbeat, state="draining"))


def test_a_client_that_vanishes_disturbs_no_other(system: System, witness: Session) -> None:
    with Client(system.control) as vanishing:
        vanishing.open_session(encoding="f32le").push(np.zeros(320, np.float32))
