"""Clients that send bad input, speak for others or attack: the services continue for all others."""

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from kouxing_client import Client, FapFrame, KouxingError, Refused, Session, find_key
from kouxing_client.messages import Event, Message, Phone, Speech

from kouxing.evaluation.system.attackers import ATTACKS, BUSY_PROCESSOR
from kouxing.evaluation.system.attacks import MemoryUsage
from kouxing.services.control.service_registry import MAX_SERVICES_PER_KEY
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus, ProbeResult
from kouxing.shared.network.sockets import Socket
from kouxing.shared.settings.keys import add_key, key_folder, load_key, load_user_key, revoke_key
from kouxing.shared.wire.control import Heartbeat, HeartbeatReply, SessionProgress
from kouxing.shared.wire.events import batch_messages
from kouxing.shared.wire.session import AudioChunk, Error
from kouxing.shared.wire.speech import AudioState, Progress
from tests.e2e.streaming import StreamedSession
from tests.system import CHAIN, DEMO, LIMIT_S, System, samples_of_file, wait_until

MessageType = TypeVar("MessageType", bound=Message)
HEARTBEAT = Heartbeat(
    service="driver", instance="a-false-one", role="observer", state="ready", sent_ns=0
)
ENDPOINTS = {"audio": "tcp://127.0.0.1:1", "phones": "tcp://127.0.0.1:1"}


@pytest.fixture(scope="module")
def services() -> Collection[str]:
    return CHAIN


def received_by(socket: Socket) -> Iterator[object]:
    """Yield the messages that arrive at a socket."""
    while socket.wait(LIMIT_S):
        for received in socket.receive():
            yield received.message


def answers(socket: Socket, kind: type[MessageType]) -> Iterator[MessageType]:
    """Yield the messages of a kind that arrive at a socket."""
    return (message for message in received_by(socket) if isinstance(message, kind))


def instances(client: Client) -> set[str]:
    return {state.instance for state in client.status().services}


@pytest.mark.parametrize("name", ["client", "driver"])
@pytest.mark.parametrize(
    "forged",
    [
        {"service": "recognizer", "role": "worker", "endpoints": ENDPOINTS},
        {"role": "worker", "endpoints": ENDPOINTS},
        {"instance": "recognizer", "role": "worker", "endpoints": ENDPOINTS},
        {"instance": "recognizer", "state": "draining"},
    ],
)
def test_no_key_may_send_messages_of_another_service(
    system: System, client: Client, witness: Session, name: str, forged: dict[str, object]
) -> None:
    load_key("driver", ("service:driver",))
    before = instances(client)
    with Bus(load_key(name, ())) as bus:
        stranger = bus.connect_dealer(system.control)
        stranger.send(replace(HEARTBEAT, **forged))
        assert next(answers(stranger, Error)).code == "not-allowed"
    assert instances(client) == before
    session = client.open_session(paced=False)
    assert session.info["audio"] == witness.info["audio"]
    session.close()


def test_only_its_worker_reports_a_session_as_idle(
    system: System, client: Client, witness: Session
) -> None:
    with Bus(load_key("driver", ("service:driver",))) as bus:
        stranger = bus.connect_dealer(system.control)
        idle = {witness.name: SessionProgress(idle_s=1e9)}
        stranger.send(replace(HEARTBEAT, sessions=idle))
        wait_until(lambda: "a-false-one" in instances(client))
        assert witness.name in {item.session for item in client.status().sessions}
        stranger.send(replace(HEARTBEAT, state="draining"))
        wait_until(lambda: "a-false-one" not in instances(client))


def test_only_a_services_own_messages_become_events(
    system: System, client: Client, witness: Session
) -> None:
    events = witness.events()
    with Bus(load_user_key()) as bus:
        stranger = bus.connect_dealer(system.control)
        # until the subscription is in effect
        wait_until(lambda: events.get(0.05) is not None, step=witness.flush)
        for message in (
            Event(session=witness.name, name="recorded", detail="/etc/passwd"),
            Speech(session=witness.name, epoch=1, active=True),
            Event(session=witness.name, name="error", detail="forged"),
        ):
            stranger.send(message)
        names = set()
        while "session-flushed" not in names:
            witness.flush()
            names |= {event.name for event in events.available()}
    assert not names & {"recorded", "speech-start", "error"}


def test_only_the_sessions_recognizer_moves_its_face(
    system: System, client: Client, witness: Session
) -> None:
    output = witness.frames()
    forged: list[Message] = [
        Phone(index=0, symbol="a", duration=9, confidence=1.0, final=True),
        Progress(level_db=0.0),
        Progress(state=AudioState.ENDED),
    ]
    endpoint = system.endpoints()["phone_input"]
    with Bus(load_key("driver", ("service:driver",))) as bus:
        stranger = bus.connect_dealer(endpoint)
        for number, message in enumerate(forged, start=1):
            header = {"session": witness.name, "epoch": 1, "sequence": number}
            stranger.send(batch_messages([replace(message, **header, media_time=123_200)]))
        witness.push(samples_of_file(DEMO / "hello-female.wav")[:16000])
        frames: list[FapFrame] = []
        wait_until(lambda: len(frames) >= 30, step=lambda: frames.extend(output.available(0.1)))
        assert not output.has_ended, "a false end"
        assert max(frame.media_time for frame in frames) <= 16000
        stranger.send(Progress())
        assert isinstance(next(received_by(stranger)), Error), "it gets no sequence number"
    with Bus(load_user_key()) as bus:
        assert bus.probe(endpoint) is ProbeResult.REJECTED, "a client does not even get in"


@pytest.fixture
def laptop_client(
    tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Client]:
    """A client of another machine, whose key, ``laptop``, has the role of a subscriber."""
    add_key("laptop", ("subscriber:shown",), tmp_path / "laptop.key")
    with monkeypatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path))
        key_folder().mkdir(mode=0o700)
        (tmp_path / "laptop.key").rename(key_folder() / "client.key")
        key = find_key()
    with Client(system.control, key=key, timeout_s=5.0) as subscriber:
        yield subscriber
    with contextlib.suppress(UserError):  # revoked already
        revoke_key("laptop")


def test_roles_limit_what_a_key_may_do(
    laptop_client: Client, client: Client, witness: Session
) -> None:
    assert witness.name in {item.session for item in laptop_client.status().sessions}
    with pytest.raises(Refused, match=r"not-allowed: the key laptop has no role client"):
        laptop_client.open_session()
    with pytest.raises(Refused, match=r"not-allowed: .* no role client or operator"):
        laptop_client.set_face(witness.name, expressions={"joy": 1.0})


def test_revoking_a_key_disconnects_its_follower(
    system: System, laptop_client: Client, client: Client
) -> None:
    shown = client.open_session(name="shown", encoding="f32le", paced=False)
    followed = laptop_client.follow("shown").frames()
    samples = samples_of_file(DEMO / "hello-female.wav")
    shown.push(samples[:16000])
    assert followed.get(LIMIT_S) is not None
    revoke_key("laptop")
    frames = shown.frames()

    def is_rejected() -> bool:  # once control has seen it
        try:
            laptop_client.status()
        except KouxingError as error:
            return "does not accept" in str(error)
        return False

    wait_until(is_rejected)
    shown.push(samples[16000:32000])
    assert frames.get(LIMIT_S) is not None
    received: list[FapFrame] = []
    with pytest.raises(KouxingError, match="does not accept"):
        received.extend(followed)
    assert all(frame.media_time <= 16000 for frame in received)
    shown.close()


def test_rejects_nan_and_accepts_empty_chunks_silence_and_clipping(
    client: Client, witness: Session
) -> None:
    with client.open_session(encoding="f32le", paced=False) as session:
        streamed = StreamedSession(session)
        session.push(np.array([0.0, np.nan, 0.0], np.float32).tobytes())
        errors: list[Refused] = []
        wait_until(lambda: errors, step=lambda: errors.extend(session.take_errors()))
        assert [error.code for error in errors] == ["bad-audio"]
        for samples in (np.zeros(0), np.zeros(8000), np.full(8000, 1e9)):
            session.push(samples.astype(np.float32).tobytes())
        streamed.finish()
    assert streamed.times[-1] >= 16000
    assert np.isfinite(streamed.faps).all()


def test_unknown_sessions_and_foreign_tokens_are_rejected(
    client: Client, bus: Bus, witness: Session
) -> None:
    audio = bus.connect_dealer(witness.info["audio"])
    for name, code in [("nobody", "unknown-session"), (witness.name, "bad-token")]:
        audio.send(AudioChunk(session=name, token="guess", sequence=1, pcm=b""))
        error = next(answers(audio, Error))
        assert (error.code, error.session) == (code, name)
        with pytest.raises(Refused, match=name) as caught:
            client.request("close-session", name, token="guess")
        assert caught.value.code == code


def test_a_client_that_vanishes_disturbs_no_other(system: System, witness: Session) -> None:
    with Client(system.control) as vanishing:
        vanishing.open_session(encoding="f32le").push(np.zeros(320, np.float32))


SERVICES = {"commands": "control", "audio": "recognizer", "faps": "synthesizer"}  # by target
MAX_GROWTH_MB = {False: 8.0, True: 64.0}  # without a key, with a key
MAX_KEPT_MB = 8.0
SECONDS = 0.5
RUNS = [
    (name, [target for target in attack.targets if target in SERVICES][-1])
    for name, attack in ATTACKS.items()
    if name != BUSY_PROCESSOR and SERVICES.keys() & {*attack.targets}
]


@pytest.mark.parametrize(("name", "target"), RUNS)
def test_the_damage_of_an_attack_is_limited(
    system: System, witness: Session, name: str, target: str
) -> None:
    attack = ATTACKS[name]
    memory = MemoryUsage(system.process(SERVICES[target]).pid)
    source = f"127.0.1.{2 + RUNS.index((name, target))}"
    attack.run(system.endpoints()[target], source, SECONDS)
    assert memory.growth_mb < MAX_GROWTH_MB[attack.has_key]
    assert memory.wait_until_kept(MAX_KEPT_MB, 60.0), memory.kept_mb


def test_very_many_false_services_leave_the_status_readable(tmp_path: Path) -> None:
    with (
        System(["control"], tmp_path) as system,
        Client(system.control) as client,
        Bus(load_key("lamp", ("service:lamp",))) as bus,
    ):
        stranger = bus.connect_dealer(system.control)
        metrics = {f"{number:0128}": 0.0 for number in range(64)}
        heartbeat = replace(HEARTBEAT, service="lamp", metrics=metrics)
        for number in range(MAX_SERVICES_PER_KEY):
            stranger.send(replace(heartbeat, instance=f"{number:0128}"))
            next(answers(stranger, HeartbeatReply))
        stranger.send(replace(heartbeat, instance="one-too-many"))
        assert next(answers(stranger, Error)).code == "too-many-services"
        lamps = [item for item in client.status().services if item.service == "lamp"]
        assert len(lamps) == MAX_SERVICES_PER_KEY
