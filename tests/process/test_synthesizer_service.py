"""Several sessions of one synthesizer, without sockets."""

import time
from collections.abc import Iterator
from typing import Any, cast

import pytest
from kouxing_client.messages import EndOfFaps, Event, FapFrame, Message, SessionFacts

from kouxing.services.synthesizer import face_maker
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.services.synthesizer.service import MAX_BURST_S, MAX_QUEUED_EVENTS, SynthesizerService
from kouxing.shared.clock import to_samples
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import Peer
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import Error
from kouxing.shared.wire.speech import AudioState, Progress
from tests.samples import SAMPLES
from tests.system import free_port

LOCAL = "tcp://127.0.0.1:*"
RATE_HZ = 50
START = replace(cast(StartSession, SAMPLES["start-session"]), epoch=1, endpoints={})


class RecordingSynthesizer(SynthesizerService):
    """A synthesizer without control that stores published frames."""

    def __init__(self) -> None:
        self.sent: list[FapFrame | EndOfFaps] = []
        control = f"tcp://127.0.0.1:{free_port()}"
        super().__init__(
            SynthesizerConfig(phone_input=LOCAL, faps=LOCAL, control=control, insecure=True)
        )
        cast(Any, self._faps).send = self.sent.append

    def receive_progress(self, session: str, sequence: int, time_s: float, epoch: int = 1) -> None:
        """Receive a progress message up to a time."""
        header: dict[str, Any] = {"session": session, "epoch": epoch, "sequence": sequence}
        self._on_input(Progress(**header, media_time=to_samples(time_s), level_db=-60.0), Peer())

    def report(self, session: str, sequence: int, state: AudioState, media_time: int = 0) -> None:
        """Receive the recognizer's report about a client's audio."""
        header: dict[str, Any] = {"session": session, "epoch": 1, "sequence": sequence}
        self._on_input(Progress(**header, media_time=media_time, state=state), Peer())

    def frames(self, session: str) -> list[FapFrame]:
        """Return the frames of a session so far."""
        return [m for m in self.sent if isinstance(m, FapFrame) and m.session == session]


@pytest.fixture
def service() -> Iterator[RecordingSynthesizer]:
    service = RecordingSynthesizer()
    for name in ("gap", "other"):
        service.start_session(replace(START.with_face(FaceSettings()), session=name))
    yield service
    service.bus.close()


def test_reports_the_default_settings_of_faces(service: RecordingSynthesizer) -> None:
    assert (service.facts.expressiveness, service.facts.feeling) == (1.4, 0.5)


def record_events(
    service: RecordingSynthesizer, monkeypatch: pytest.MonkeyPatch
) -> list[tuple[str, ...]]:
    """Return a list that receives the events that a service publishes."""
    events: list[tuple[str, ...]] = []
    monkeypatch.setattr(
        service,
        "publish_event",
        lambda name, start, detail: events.append((name, start.session, detail)),
    )
    return events


def test_ignores_unknown_names(service: RecordingSynthesizer) -> None:
    face = FaceSettings(expressions={"glee": 1.0, "joy": 0.5}, shapes=["clay", "vrm"])
    service.change_face(SetFace(session="gap", face=face))
    service.receive_progress("gap", 1, 1.0)
    assert {tuple(frame.shapes) for frame in service.frames("gap")} == {("vrm",)}


def fail_to_load(language: str, name: str) -> LipModel:
    """Load only the default lip model."""
    if name != DEFAULT_LIP_MODEL or language != DEFAULT_LANGUAGE:
        raise UserError(f"{name} cannot be loaded for {language}")
    return load_lip_model(language, name)


@pytest.mark.parametrize(
    ("lip_model", "language", "code"),
    [(DEFAULT_LIP_MODEL, "toy", "bad-language"), ("ferguson", DEFAULT_LANGUAGE, "bad-face")],
)
def test_a_session_is_rejected_if_its_lip_model_cannot_be_loaded(
    service: RecordingSynthesizer,
    monkeypatch: pytest.MonkeyPatch,
    lip_model: str,
    language: str,
    code: str,
) -> None:
    sent: list[Message] = []
    monkeypatch.setattr(face_maker, "load_lip_model", fail_to_load)
    monkeypatch.setattr(service, "send_to_control", sent.append)
    start = replace(
        START.with_face(FaceSettings(lip_model=lip_model)),
        session="new",
        facts=SessionFacts(language=language),
    )
    service._on_start_session(start, Peer())
    event, error = sent
    assert isinstance(event, Event)
    assert event.detail == f"{code}: {lip_model} cannot be loaded for {language}"
    assert isinstance(error, Error)
    assert (error.code, error.text) == (code, f"{lip_model} cannot be loaded for {language}")
    assert "new" not in service._sessions


@pytest.mark.parametrize(("change", "epoch"), [("set-face", 1), ("move", 2)])
def test_a_session_continues_if_its_new_lip_model_cannot_be_loaded(
    service: RecordingSynthesizer, monkeypatch: pytest.MonkeyPatch, change: str, epoch: int
) -> None:
    events = record_events(service, monkeypatch)
    monkeypatch.setattr(face_maker, "load_lip_model", fail_to_load)
    face = FaceSettings(lip_model="ferguson", shapes=["vrm"])
    if change == "move":
        service.stop_session("gap")
        service.start_session(replace(START.with_face(face), session="gap", epoch=epoch))
    else:
        service.change_face(SetFace(session="gap", face=face))
    text = f"bad-face: ferguson cannot be loaded for {DEFAULT_LANGUAGE}"
    assert events == [("error", "gap", text)]
    for sequence in (1, 2):
        service.receive_progress("gap", sequence, 1.0 * sequence, epoch)
    assert {tuple(frame.shapes) for frame in service.frames("gap")} == {("vrm",)}


def test_frames_of_a_client_with_a_slow_clock_are_made_at_once(
    service: RecordingSynthesizer,
) -> None:
    service.receive_progress("gap", 1, 0.1)
    skip_policy = service._sessions["gap"].skip_policy
    skip_policy._due_s = time.monotonic() - 10.0  # it has fallen behind over hours
    was_at_once = []
    for sequence in range(2, 52):
        num_before = len(service.frames("gap"))
        service.receive_progress("gap", sequence, 0.08 + 0.02 * sequence)
        was_at_once.append(len(service.frames("gap")) > num_before)
        service.on_tick(time.monotonic())
        assert len(service.frames("gap")) > num_before
    assert not was_at_once[0], "newer events may have arrived"
    assert was_at_once[-1]


def test_a_gap_does_not_delay_other_sessions(service: RecordingSynthesizer) -> None:
    service.receive_progress("gap", 1, 9.9)
    assert len(service.frames("gap")) == round(MAX_BURST_S * RATE_HZ)
    service.receive_progress("other", 1, 0.02 + SynthesizerConfig().delay_ms / 1e3)
    assert len(service.frames("other")) == 2
    service.receive_progress("gap", 2, 9.92)
    service.report("gap", 3, AudioState.ENDED, 158_720)
    num_ticks = 0
    while not any(isinstance(message, EndOfFaps) for message in service.sent):
        before = len(service.frames("gap"))
        service.on_tick(0.0)
        num_ticks += 1
        assert len(service.frames("gap")) <= before + round(MAX_BURST_S * RATE_HZ)
    times = [frame.media_time for frame in service.frames("gap")]
    assert times == list(range(0, times[-1] + 1, to_samples(1 / RATE_HZ)))
    assert times[-1] >= to_samples(9.92)
    assert num_ticks > 100


def test_rejects_messages_beyond_the_queue(service: RecordingSynthesizer) -> None:
    for sequence in range(1, MAX_QUEUED_EVENTS + 10):
        service.receive_progress("gap", sequence, 5.0 + sequence * 0.02)
    assert len(service._sessions["gap"].events) == MAX_QUEUED_EVENTS
    for _ in range(300):
        service.on_tick(0.0)
    assert service.frames("gap")[-1].media_time < to_samples(5.0 + MAX_QUEUED_EVENTS * 0.02 + 0.02)
    service.receive_progress("gap", MAX_QUEUED_EVENTS + 1, 5.0 + (MAX_QUEUED_EVENTS + 1) * 0.02)
    assert service.frames("gap")[-1].media_time == to_samples(
        5.0 + (MAX_QUEUED_EVENTS + 1) * 0.02 - SynthesizerConfig().delay_ms / 1e3
    )
    assert not service._sessions["gap"].events


def test_a_slow_synthesizer_skips_frames_and_reports_it(
    service: RecordingSynthesizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, events = 0.0, record_events(service, monkeypatch)
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    service.receive_progress("gap", 1, 0.08)
    now_s = 10.0  # it was stopped
    for sequence in range(2, 150):
        service.receive_progress("gap", sequence, 0.1 * sequence)
    before = len(service.frames("gap"))
    service.report("gap", 150, AudioState.SKIPPED, 320_000)
    service.receive_progress("gap", 151, 20.0)
    for _ in range(2):
        service.on_tick(now_s)
    assert not service._sessions["gap"].events
    first, newest = service.frames("gap")[before], service.frames("gap")[-1]
    newest_s = 20.0 - SynthesizerConfig().delay_ms / 1e3
    assert first.media_time == newest.media_time == to_samples(newest_s)
    assert service.session_progress()["gap"].skipped_s == pytest.approx(14.7)
    assert events == [("audio-skipped", "gap", "14.70 s")]


def test_the_face_waits_for_a_slow_recognizer_and_rests_for_a_silent_client(
    service: RecordingSynthesizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)

    def times_until(end_s: float) -> list[int]:
        """Return the media times of the frames that are made until a time."""
        nonlocal now_s
        num_before = len(service.frames("gap"))
        while now_s < end_s:
            now_s += 0.04
            service.on_tick(now_s)
        return [frame.media_time for frame in service.frames("gap")[num_before:]]

    service.receive_progress("gap", 1, 1.0)
    (*_, newest) = times_until(1.0)
    assert times_until(10.0) == []
    service.report("gap", 2, AudioState.STALLED)
    at_rest = times_until(11.0)
    assert {*at_rest} == {newest}
    assert len(at_rest) == pytest.approx(RATE_HZ, abs=2)
    service.report("gap", 3, AudioState.RESUMED)
    assert times_until(20.0) == []
    service.receive_progress("gap", 4, 1.1)
    times_until(20.1)
    frames = service.frames("gap")
    assert [frame.sequence for frame in frames] == [*range(1, len(frames) + 1)]
    last = to_samples(1.1 - SynthesizerConfig().delay_ms / 1e3)
    assert sorted({frame.media_time for frame in frames}) == [*range(0, last + 1, 320)]
