"""The recognizer's loop with real sockets: how much it does at a time."""

import threading
import time
from collections.abc import Iterator
from itertools import count, pairwise

import pytest
from kouxing_client.field_types import MAX_AUDIO_BYTES
from kouxing_client.messages import Message, SessionFacts, Speech

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.service import MAX_TICK_S, RecognizerService
from kouxing.services.recognizer.sessions import pending_sessions
from kouxing.services.recognizer.sessions.live_batch_decoder import MAX_BATCH_S
from kouxing.services.recognizer.sessions.session import STALLED_AFTER_S
from kouxing.services.recognizer.sessions.unpaced_decoder import MAX_UNPACED_S
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.peer import Peer
from kouxing.shared.wire.control import EventName, StartSession
from kouxing.shared.wire.face import FaceSettings, SetFace
from kouxing.shared.wire.session import AudioChunk, Error, FlushSession
from kouxing.shared.wire.speech import AcousticModelName, AudioState, Progress
from tests.live_streams import START
from tests.samples import with_opening
from tests.system import LIMIT_S, free_port, wait_until

RATE_HZ = START.opening.sample_rate_hz
PHONE_INPUT = {"phone_input": f"tcp://127.0.0.1:{free_port()}"}
UNPACED = replace(with_opening(START, paced=False), endpoints=PHONE_INPUT)


class Recognizer(RecognizerService):
    """Records warnings, and the sessions' media times whenever a heartbeat may be sent."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        nobody = f"tcp://127.0.0.1:{free_port()}"
        super().__init__(
            RecognizerConfig(
                control=nobody, audio=local, phones=local, unpaced_audio=local, insecure=True
            )
        )
        self.media_times: list[int] = [0]
        self.warned: list[tuple[str, str]] = []
        self.started: list[str] = []
        self.events: list[tuple[str, ...]] = []

    def publish_event(
        self, name: EventName, start: StartSession, detail: str = "", media_time: int = 0
    ) -> None:
        self.events.append((name, start.session, detail))

    def warn(self, reason: str, text: str, session: str = "", level: int = 0) -> None:
        self.warned.append((reason, text))

    def session_started(self, start: StartSession, final_until: int = 0) -> None:
        self.started.append(start.session)

    def send_heartbeat_if_due(self) -> None:
        self.media_times += [session.stream.media_time for session in self._sessions.values()]

    def receive(self, message: AudioChunk) -> None:
        """Handle a client's message."""
        self._on_audio(self._sessions[message.session].socket, message, Peer())

    def decode_all(self) -> None:
        while self._has_live_audio:
            self._live.decode(self._live_sessions)
        while self._unpaced.has_audio:
            self._unpaced.decode()
            self.send_heartbeat_if_due()


@pytest.fixture
def service() -> Iterator[Recognizer]:
    running = Recognizer()
    yield running
    running.bus.close()


def chunk(number: int, num_bytes: int, session: str = "s") -> AudioChunk:
    """Return the ``number``-th chunk of this size, from 0."""
    return AudioChunk(
        session=session,
        token="t",
        sequence=number + 1,
        media_time=number * num_bytes,
        pcm=bytes(num_bytes),
    )


def test_reports_speech_in_progress_to_a_restarted_control(service: Recognizer) -> None:
    service.start_session(UNPACED)
    assert [start.speech_time for start in service.served_sessions()] == [None]
    service._sessions["s"].speech_time = 2840
    assert [start.speech_time for start in service.served_sessions()] == [2840]


def test_accepts_the_next_audio_after_a_flush_whatever_its_number(service: Recognizer) -> None:
    service.start_session(UNPACED)
    service.receive(replace(chunk(0, 640), acknowledge=True))
    service.flush_session(FlushSession(session="s", request="r", token="t", sequence=4))
    service.receive(replace(chunk(4, 640), acknowledge=True))
    assert service._sessions["s"].last_sequence == 5


def test_drops_audio_that_arrives_after_its_flush(service: Recognizer) -> None:
    service.start_session(UNPACED)
    session = service._sessions["s"]
    service.flush_session(FlushSession(session="s", request="r", token="t", sequence=3))
    for number in range(3):
        service.receive(chunk(number, 640))
        assert not session.audio
    service.receive(chunk(3, 640))
    assert session.audio.media_time == 3 * 640


def test_delivers_a_repeated_message_once_and_acknowledges_it_again(service: Recognizer) -> None:
    service.start_session(UNPACED)
    session = service._sessions["s"]
    for number in range(2):
        session.acknowledge_due_s = None
        service.receive(replace(chunk(number, 640), sequence=1, acknowledge=True))
        assert session.acknowledge_due_s is not None
    service.decode_all()
    assert session.stream.next_media_time == 640


@pytest.mark.parametrize("paced", [False, True])
def test_a_flush_drops_audio_that_is_not_decoded(service: Recognizer, paced: bool) -> None:
    service.start_session(with_opening(UNPACED, paced=paced))
    service.receive(chunk(0, MAX_AUDIO_BYTES))
    service._live.decode(service._live_sessions)
    session = service._sessions["s"]
    accepted = session.stream.next_media_time
    service.flush_session(FlushSession(session="s", request="r", token="t", sequence=1))
    assert not session.audio
    assert session.stream.next_media_time == accepted


def test_after_a_flush_the_last_report_is_that_the_client_has_stalled(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.start_session(with_opening(UNPACED, paced=True))
    session = service._sessions["s"]
    session.stream._is_speaking = True
    sent: list[Message] = []
    monkeypatch.setattr(session.link, "send", lambda message, _: sent.append(message))
    service.flush_session(FlushSession(session="s", request="r", token="t", sequence=1))
    speech, report = sent
    assert isinstance(speech, Speech)
    assert isinstance(report, Progress)
    assert report.state == AudioState.STALLED


def test_reports_a_stalled_client_while_others_send_audio(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    stalled: list[str] = []
    for name in ("silent", "sending", "decoding"):
        service.start_session(replace(with_opening(UNPACED, paced=True), session=name))

        def record(message: Message, _now_s: float, name: str = name) -> None:
            assert isinstance(message, Progress)
            assert message.state == AudioState.STALLED
            stalled.append(name)

        monkeypatch.setattr(service._sessions[name].link, "send", record)
    start_s = service._last_stall_check_s
    service.receive(chunk(0, 640, "sending"))
    service._sessions["decoding"].is_scoring = True
    for number in range(1, round(STALLED_AFTER_S / MAX_TICK_S) + 2):
        service._report_stalled(start_s + number * MAX_TICK_S)
    assert stalled == ["silent"]
    service._sessions["decoding"].is_scoring = False
    service._report_stalled(start_s + 1.0)
    assert stalled == ["silent"], "the time of decoding does not count"


def test_late_audio_does_not_delay_other_sessions(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("late", "other"):
        service.start_session(replace(with_opening(UNPACED, paced=True), session=name))
    service.receive(chunk(0, 640, "late"))
    policy = service._sessions["late"].audio.skip_policy
    policy._due_s = due_s = time.monotonic() - 10.0
    numbers = count()
    monkeypatch.setattr(service._audio, "wait", lambda _: True)
    monkeypatch.setattr(
        service, "handle_messages", lambda _: service.receive(chunk(next(numbers), 640, "other"))
    )
    service._read_late_audio()
    assert next(numbers) == 1
    assert policy._due_s > due_s, "the newest audio may be on time"


@pytest.mark.parametrize("paced", [False, True])
def test_decodes_a_long_chunk_in_parts_with_heartbeats_between(
    service: Recognizer, paced: bool
) -> None:
    service.start_session(with_opening(UNPACED, paced=paced))
    service.receive(chunk(0, MAX_AUDIO_BYTES))
    service.decode_all()
    steps = [after - before for before, after in pairwise(service.media_times)]
    assert max(steps) <= MAX_BATCH_S * 16000 + 320
    # 2 bytes per sample at half the rate
    assert service.media_times[-1] == pytest.approx(MAX_AUDIO_BYTES, abs=MAX_BATCH_S * 16000)


def test_decodes_live_audio_before_unpaced_audio(service: Recognizer) -> None:
    service.start_session(UNPACED)
    service.start_session(replace(with_opening(UNPACED, paced=True), session="live"))
    live, other = (service._sessions[name].stream for name in ("live", "s"))
    num_long, num_short = 12, 100
    with Bus() as bus:
        unpaced = bus.connect_dealer(service.endpoints["unpaced_audio"])
        for number in range(num_long):  # of 0.5 s
            unpaced.send(chunk(number, RATE_HZ))
        paced = bus.connect_dealer(service.endpoints["audio"])
        for number in range(num_short):  # of 20 ms
            paced.send(chunk(number, 320, "live"))
            assert service._audio.wait(LIMIT_S)
            before = other.media_time
            service.step(0.0)
            assert live.next_media_time == 320 * (number + 1)  # at once
            assert other.media_time - before <= MAX_UNPACED_S * 16000 + 320
        wait_until(
            lambda: other.next_media_time >= 8000 * num_long, step=lambda: service.step(0.01)
        )
        assert other.next_media_time == 8000 * num_long
        assert other.num_gaps == 0  # no audio was dropped
    assert not service.warned


def test_skips_audio_that_arrived_while_the_process_was_stopped(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    monkeypatch.setattr(service, "resync_with_control", lambda: None)  # which does not answer
    service.start_session(with_opening(UNPACED, paced=True))
    for number in range(150):  # of 20 ms
        now_s += 0.02
        service.receive(chunk(number, 320))
        service.decode_all()
    now_s += 2.0
    for number in range(150, 250):
        service.receive(chunk(number, 320))
    service.decode_all()
    service.on_tick(now_s)
    assert service._sessions["s"].stream.next_media_time == 320 * 250
    assert service.events == [("audio-skipped", "s", "1.98 s")]
    assert service.session_progress()["s"].skipped_s == pytest.approx(1.98)


def test_other_sessions_continue_while_a_model_is_loaded(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_released, loaded_on = threading.Event(), list[int]()

    def load_slowly(language: str) -> AcousticModel:
        loaded_on.append(threading.get_ident())
        assert is_released.wait(LIMIT_S)
        return load_model_for_language(language)

    monkeypatch.setattr(pending_sessions, "load_model_for_language", load_slowly)
    german = replace(UNPACED, session="de", facts=SessionFacts(language="german"))
    live = replace(with_opening(UNPACED, paced=True), session="live")
    for start in (live, german, replace(german, session="closed")):
        service._on_start_session(start, Peer())
    service.receive(chunk(0, 3200, "live"))
    service.decode_all()
    assert service._sessions["live"].stream.media_time > 0
    service.change_face(SetFace(session="de", face=FaceSettings(acoustic=AcousticModelName.LIGHT)))
    service.stop_session("closed")
    assert service.started == ["live"]
    is_released.set()
    wait_until(lambda: len(service.started) >= 2, step=lambda: service.step(0.01))
    assert service.started == ["live", "de"]
    assert {*service._sessions} == {"live", "de"}
    assert service._sessions["de"].face.settings.acoustic == AcousticModelName.LIGHT
    assert len(loaded_on) == 1
    assert loaded_on != [threading.get_ident()]
    assert service.start_session(replace(german, session="later"))  # at once
    service.receive(chunk(0, 3200, "later"))
    service.decode_all()
    assert service._sessions["later"].stream.media_time > 0


def test_a_session_is_rejected_if_its_model_cannot_be_loaded(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(language: str) -> AcousticModel:
        raise UserError(f"no model for {language}")

    sent = list[Message]()
    monkeypatch.setattr(pending_sessions, "load_model_for_language", fail)
    monkeypatch.setattr(service, "send_to_control", sent.append)
    service._on_start_session(replace(UNPACED, facts=SessionFacts(language="german")), Peer())
    wait_until(lambda: service.warned, step=lambda: service.step(0.01))
    assert service.warned == [("start", "no model for german")]
    (error,) = sent
    assert isinstance(error, Error)
    assert (error.session, error.request) == (UNPACED.session, UNPACED.request)
    assert (error.code, error.text) == ("bad-language", "no model for german")
    assert not service._sessions


def test_session_is_rejected_without_a_link_to_its_synthesizer(
    service: Recognizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = list[Message]()
    monkeypatch.setattr(service, "send_to_control", sent.append)
    start = replace(UNPACED, endpoints={**UNPACED.endpoints, "phone_input": "nowhere"})
    service._on_start_session(start, Peer())
    (error,) = sent
    assert isinstance(error, Error)
    assert error.code == "no-service"
    assert "nowhere" in error.text
