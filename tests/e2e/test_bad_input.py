"""Bad input of every kind: a clear answer, no service dies, other sessions go on."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import zmq
from kouxing_client import Client, KouxingError, Refused, Session, Sound

from kouxing.evaluation.system.attackers import connect
from kouxing.shared.bus import Bus
from kouxing.shared.keys import load_key, user_key
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk
from kouxing.shared.wire.control import Heartbeat, SessionInput
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import Error, OpenSession
from kouxing.shared.wire.speech import Phone, Progress
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


def test_a_bad_mouth_profile_is_refused_and_the_session_goes_on(
    client: Client, witness: Session
) -> None:
    session = client.open_session(encoding="f32le", mouth_profile=b"no profile")
    output = session.frames()
    session.push(np.zeros(8000, np.float32))
    error = first_error(session)
    assert (error.code, "not a mouth profile" in error.text) == ("bad-mouth-profile", True)
    assert output.get(60.0) is not None
    session.close()
    with pytest.raises(Refused, match="bad-message"):
        client.open_session(mouth_profile=bytes(70_000))


def test_half_a_sample_is_refused(client: Client, bus: Bus, witness: Session) -> None:
    session = client.open_session(encoding="s16le", num_channels=2)
    with pytest.raises(KouxingError, match="not whole samples"):
        session.push(b"\0" * 6)
    audio, token = bus.connect_dealer(session.info["audio"]), session.info["token"]
    audio.send(AudioChunk(session=session.name, token=token, sequence=1, pcm=b"\0" * 6))
    error = next(answers(audio))
    assert error.code == "bad-audio"
    assert "2 channels" in error.text
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
    assert isinstance(answer.message, AcknowledgeAudio)
    assert answer.message.sequence == 1
    assert output.get(0.2) is None


def test_a_second_client_with_the_same_name_is_refused(
    system: System, client: Client, witness: Session
) -> None:
    with Client(system.control) as other, pytest.raises(Refused, match="choose another name"):
        other.open_session(name=witness.name)


def test_audio_after_the_end_is_refused(client: Client, witness: Session) -> None:
    session = client.open_session(encoding="f32le")
    session.finish()
    session.push(np.zeros(320, np.float32))
    assert first_error(session).code == "finished"
    session.close()


@pytest.mark.parametrize(
    "fields",
    [
        {"sample_rate_hz": 192000},
        {"sample_rate_hz": 0},
        {"num_channels": 6},
        {"encoding": "u8"},
        {"session": "../../etc/passwd"},
        {"session": "x" * 65},
    ],
)
def test_what_the_wire_cannot_carry_is_refused(
    client: Client, bus: Bus, witness: Session, system: System, fields: dict[str, object]
) -> None:
    socket = bus.connect_dealer(system.control)
    socket.send(OpenSession(request="r", **fields))  # type: ignore[arg-type]
    error = next(answers(socket))
    assert error.code == "bad-message"
    assert next(iter(fields)) in error.text or "topic" in error.text


GARBAGE: list[list[bytes]] = [
    [b""],
    [b"\xff" * 40],
    [b"fap-frame/x/", b"\xc1"],
    [b"audio-chunk/x/"] * 3,
    [b"a"] * 50,
    [os.urandom(30), os.urandom(2000)],
    [b"open-session//", b"\x81" * 3000],
    [b"x" * 500_000, b""],
]


def test_garbage_on_every_port_harms_nobody(system: System, witness: Session) -> None:
    kinds = (zmq.DEALER, zmq.SUB, zmq.XSUB, zmq.PUSH)
    with zmq.Context() as context:
        for endpoint, kind in itertools.product(system.endpoints().values(), kinds):
            for key in (user_key(), load_key("driver", ())):
                with garbage_socket(context, kind) as raw:
                    connect(raw, endpoint, key)
                    throw_garbage(raw, kind)
        for port in system.ports:
            for kind in kinds:
                with garbage_socket(context, kind) as raw:
                    raw.connect(f"tcp://127.0.0.1:{port}")
                    throw_garbage(raw, kind)
            with (
                socket.create_connection(("127.0.0.1", port)) as plain,
                contextlib.suppress(ConnectionError),  # it may be cut at the first bytes
            ):
                plain.sendall(b"GET / HTTP/1.1\r\n\r\n" + os.urandom(500))
    system.assert_all_alive()


def garbage_socket(context: zmq.Context[zmq.Socket[bytes]], kind: int) -> zmq.Socket[bytes]:
    """Return a socket that has time to send its garbage, and does not connect again.

    libzmq aborts if a connection ends in the midst of a message just when the time that a closed
    socket has for it is over.
    """
    raw = context.socket(kind)
    raw.setsockopt(zmq.RECONNECT_IVL, -1)
    raw.setsockopt(zmq.LINGER, 4000)
    raw.setsockopt(zmq.SNDTIMEO, 200)
    return raw


def throw_garbage(raw: zmq.Socket[bytes], kind: int) -> None:
    """Send all garbage this kind of socket can; one whose handshake is refused cannot send."""
    if kind == zmq.SUB:
        for topic in (b"\xff\x00garbage", b"joined/\xff\xfe/", b"joined//"):
            raw.setsockopt(zmq.SUBSCRIBE, topic)
        return
    with contextlib.suppress(zmq.Again):
        for parts in GARBAGE:
            if kind != zmq.PUSH or len(parts) == 1:
                raw.send_multipart(parts)


def test_messages_of_other_sockets_are_refused_kindly(system: System, witness: Session) -> None:
    misplaced: list[Message] = [
        Phone(session="s", index=0, symbol="a", duration=1, confidence=1.0, final=True),
        Phone(session=witness.name, index=0, symbol="qqqq", duration=1, confidence=1.0, final=True),
        Progress(session="nobody", level_db=0.0, sequence=5),
        Heartbeat(
            service="recognizer", instance="ghost", role="worker", state="draining", sent_ns=0
        ),
        FapFrame(session=witness.name, values=b"\0" * 272, mask=b"\0" * 9),
    ]
    with Bus(user_key()) as bus:
        for endpoint in system.endpoints().values():
            dealer = bus.connect_dealer(endpoint)
            for message in misplaced:
                dealer.send(message)
            dealer.wait(0.2)
    system.assert_all_alive()


def test_a_gap_in_media_time_keeps_the_new_time(client: Client, bus: Bus, witness: Session) -> None:
    session = client.open_session(encoding="f32le", paced=False)
    output = session.frames()
    token, pcm = session.info["token"], np.zeros(1600, "<f4").tobytes()
    audio = bus.connect_dealer(session.info["audio"])
    for sequence, media_time in ((1, 0), (2, 1600), (5, 160_000), (6, 161_600), (7, 163_200)):
        audio.send(
            AudioChunk(
                session=session.name,
                token=token,
                sequence=sequence,
                media_time=media_time,
                pcm=pcm,
            )
        )
    newest, end_s = 0, time.monotonic() + 60
    while newest < 162_000:
        assert time.monotonic() < end_s, newest
        for frame in output.available(0.1):
            newest = frame.media_time
    session.close()


def test_a_wall_clock_for_media_time_is_refused(client: Client, bus: Bus, witness: Session) -> None:
    session = client.open_session(encoding="f32le")
    audio = bus.connect_dealer(session.info["audio"])
    token = session.info["token"]
    audio.send(AudioChunk(session=session.name, token=token, sequence=1, media_time=2**53, pcm=b""))
    assert next(answers(audio)).code == "bad-audio"
    session.close()


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


def test_progress_of_another_epoch_is_ignored(system: System, witness: Session) -> None:
    with Bus(load_key("recognizer", ())) as bus:
        stranger = bus.connect_dealer(system.endpoints()["phone_input"])
        for epoch in (0, 2, 2**53):
            stranger.send(
                Progress(
                    session=witness.name, epoch=epoch, sequence=5, media_time=2**53, level_db=0.0
                )
            )
        time.sleep(0.3)
    system.assert_all_alive()


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
