"""A session of the recognizer: the audio that it accepts, the order of messages, its sound."""

import math
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from kouxing_client.messages import Message, Speech

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.lips.mouth_profile import MouthProfile
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.session import (
    MAX_LEAD_S,
    MAX_MEDIA_TIME,
    MOVE_GRACE_S,
    RESEND_WAIT_S,
    STALLED_AFTER_S,
    RecognizerSession,
)
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.network.sockets import Socket
from kouxing.shared.phones.events import SpeechChange
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import AudioChunk, ErrorCode
from kouxing.shared.wire.speech import (
    Acknowledge,
    Acoustic,
    AcousticModelName,
    AudioState,
    LipPositions,
    Progress,
)
from tests.live_streams import START
from tests.samples import with_opening
from tests.system import VOWELS_FILE, samples_of_file

RATE_HZ = START.opening.sample_rate_hz
SOCKET, OTHER_SOCKET = (cast(Socket, object()) for _ in range(2))


@cache
def recognizer() -> Recognizer:
    return Recognizer(load_model())


def make_session(epoch: int = 1, **opening: Any) -> RecognizerSession:
    start = with_opening(replace(START, epoch=epoch), **opening)
    return RecognizerSession(
        start, recognizer(), load_lip_predictor(), SOCKET, SOCKET, 0.0, math.inf
    )


def chunk(
    sequence: int = 1, duration_s: float = 0.02, time_s: float = 0.0, **values: Any
) -> AudioChunk:
    values = {"pcm": bytes(2 * round(duration_s * RATE_HZ)), **values}
    media_time = round(16_000 * time_s)
    return AudioChunk(
        session="s", sequence=sequence, **{"token": "t", "media_time": media_time, **values}
    )


@pytest.mark.parametrize(
    ("message", "socket", "code", "text"),
    [
        (chunk(token="x"), SOCKET, ErrorCode.BAD_TOKEN, "token"),
        (chunk(), OTHER_SOCKET, ErrorCode.BAD_AUDIO, "endpoint in session-opened"),
        (chunk(sequence=0), SOCKET, ErrorCode.BAD_AUDIO, "from 1"),
    ],
)
def test_audio_of_a_wrong_sender_is_rejected(
    message: AudioChunk, socket: Socket, code: ErrorCode, text: str
) -> None:
    make_session().check_sender(chunk(), SOCKET)
    with pytest.raises(Rejected, match=text) as rejection:
        make_session().check_sender(message, socket)
    assert rejection.value.code == code


def test_rejects_impossible_audio_and_audio_after_the_end() -> None:
    session = make_session()
    session.check_open(chunk())
    with pytest.raises(Rejected, match="too large"):
        session.check_open(chunk(media_time=MAX_MEDIA_TIME + 1))
    with pytest.raises(Rejected, match="are not a multiple of"):
        session.read_chunk(chunk(pcm=b"123"), 0.0)
    float_pcm = (0.5 * samples_of_file(VOWELS_FILE)).astype("<f4").tobytes()
    with pytest.raises(Rejected, match="perhaps 32-bit float samples") as rejection:
        session.read_chunk(chunk(pcm=float_pcm[: 16 * RATE_HZ]), 0.0)
    assert rejection.value.code == ErrorCode.BAD_AUDIO
    session.last_chunk = chunk(last=True)
    with pytest.raises(Rejected, match="has ended"):
        session.check_open(chunk(2))


class PacedClient:
    """Sends paced audio at an injected time."""

    def __init__(self, **changes: Any) -> None:
        self.session = make_session(**changes)
        self.now_s = self.end_s = 0.0

    def send(self, duration_s: float, gap_s: float = 0.0) -> bool:
        """Send audio after a gap; return whether it is accepted."""
        try:
            self.session.read_chunk(
                chunk(duration_s=duration_s, time_s=self.end_s + gap_s), self.now_s
            )
        except Rejected:
            return False
        self.end_s += gap_s + duration_s
        return True


def test_audio_after_a_gap_waits_for_the_end_of_scoring() -> None:
    session = make_session(sample_rate_hz=16_000)
    samples = samples_of_file(VOWELS_FILE)[:9600]
    session.audio.append((0, samples[:3200]), 0.0)
    session.accept_waveform(1.0, 0.0, hop=1)
    recognizer().decode_streams([session.stream])
    session.is_scoring = True
    session.stream.begin_background_scoring()
    session.audio.append((3200, samples[3200:6400]), 0.0)
    session.audio.append((16_000, samples[6400:]), 0.0)
    session.accept_waveform(1.0, 0.0, hop=1)
    assert session.stream.media_time == 6400
    assert session.audio
    assert not session.can_accept
    session.is_scoring = False
    session.stream.end_background_scoring()
    assert session.can_accept
    session.accept_waveform(1.0, 0.0, hop=1)
    assert session.stream.media_time == 19_200
    assert not session.can_accept


def test_reports_the_acoustic_model_in_use() -> None:
    session = make_session(sample_rate_hz=16_000)
    samples = samples_of_file(VOWELS_FILE)[7_000:]
    models = []
    for number, start in enumerate(range(0, 32_000, 1600)):
        light = AcousticModelName.LIGHT if number >= 8 else AcousticModelName.FULL
        session.face.change(FaceSettings(acoustic=light), 0.0)
        session.audio.append((start, samples[start : start + 1600]), start / 16_000)
        session.accept_waveform(1.0, start / 16_000, hop=1)
        recognizer().decode_streams([session.stream])
        published = session.published_messages(session.new_results())
        models.append(next((m.model for m in published if isinstance(m, Acoustic)), None))
    reported = [(number, model) for number, model in enumerate(models) if model]
    assert [model for _, model in reported][:2] == ["full", "light"]
    assert reported[1][0] == 8


@pytest.mark.parametrize(("epoch", "models"), [(1, []), (2, ["full"])])
def test_a_recognizer_reports_its_acoustic_model_after_a_move(
    epoch: int, models: list[str]
) -> None:
    silence = Speech(media_time=0, active=False)
    session = make_session(epoch)
    published = [message for _ in range(2) for message in session.published_messages([silence])]
    assert [m.model for m in published if isinstance(m, Acoustic)] == models


@pytest.mark.parametrize("acoustic", AcousticModelName)
def test_the_first_message_after_a_lost_recognizer_is_speech(acoustic: AcousticModelName) -> None:
    start = replace(with_opening(START, sample_rate_hz=16_000), epoch=2, final_until=16_000)
    session = RecognizerSession(
        start, recognizer(), load_lip_predictor(), SOCKET, SOCKET, 0.0, math.inf
    )
    session.face.change(FaceSettings(acoustic=acoustic), 0.0)
    published: list[Message] = []
    for number, samples in enumerate(samples_of_file(VOWELS_FILE)[:35_200].reshape(-1, 1600), 1):
        message = chunk(number, pcm=as_integers(samples).tobytes(), time_s=(number - 1) / 10)
        if (audio := session.read_chunk(message, number / 10)) is not None:
            session.audio.append(audio, number / 10)
        session.accept_waveform(1.0, number / 10, hop=1)
        recognizer().decode_streams([session.stream])
        published += session.published_messages(session.new_results())
    first, *others = published
    assert isinstance(first, Speech)
    assert (first.sequence, first.active, first.media_time) == (1, True, 16_000)
    assert any(isinstance(message, Acoustic) for message in others)


def test_keeps_the_start_of_the_current_speech() -> None:
    session = make_session()

    def speech_time_after(*changes: SpeechChange) -> int | None:
        cast(Any, session.stream).take_results = lambda: list(changes)
        session.new_results()
        return session.speech_time

    start, stop = (SpeechChange(active=active, time_s=2.0) for active in (True, False))
    assert speech_time_after() is None
    assert speech_time_after(start) == 32_000
    assert speech_time_after(replace(start, time_s=3.0)) == 32_000  # a repetition
    assert speech_time_after(stop) is None
    assert speech_time_after(stop, replace(start, time_s=4.0)) == 64_000


def test_limits_how_far_a_paced_client_is_ahead_of_the_clock() -> None:
    client = PacedClient()
    assert all(client.send(1.0) for _ in range(int(MAX_LEAD_S)))
    assert not client.send(1.0)
    client.now_s += 2.0
    assert [client.send(1.0) for _ in range(3)] == [True, True, False]
    client.now_s += 600.0  # a long interruption
    assert all(client.send(1.0) for _ in range(int(2 * MAX_LEAD_S)))
    assert not client.send(1.0)
    for _ in range(3600):  # the client's clock is 0.1 % faster
        client.now_s += 1.0
        assert client.send(1.001)
    client.now_s += 600.0
    assert client.send(1.0, gap_s=600.0)  # frames do not fill such a gap
    assert [client.send(1.0, gap_s=9.9) for _ in range(3)] == [True, True, False]


def reports_of(session: RecognizerSession, *, silent_s: float) -> list[str]:
    """Return what a session reports to its synthesizer about a silent client that returns."""
    reports: list[Progress] = []
    cast(Any, session.link).send = lambda message, _: reports.append(message)
    for _ in range(round(100 * silent_s)):
        session.check_stalled(0.01, 0.0)
    session.on_new_audio(0.0)
    return [report.state for report in reports]


def test_reports_a_live_client_that_stalls_and_resumes() -> None:
    session = make_session()
    for _ in range(2):
        assert reports_of(session, silent_s=1.0) == ["stalled", "resumed"]
    assert reports_of(session, silent_s=STALLED_AFTER_S / 2) == []
    assert reports_of(make_session(paced=False), silent_s=1.0) == []
    assert reports_of(make_session(epoch=2), silent_s=MOVE_GRACE_S) == [], (
        "the client is connecting"
    )


@pytest.mark.parametrize(
    ("duration_s", "num_messages", "limit_s"),
    [(0.1, 1, STALLED_AFTER_S), (0.5, 1, 0.6), (0.05, 10, 0.6), (0.5, 10, 1.1)],
)
def test_a_client_that_sends_long_messages_stalls_later(
    duration_s: float, num_messages: int, limit_s: float
) -> None:
    client = PacedClient()
    assert all(client.send(duration_s) for _ in range(num_messages))
    assert reports_of(client.session, silent_s=limit_s - 0.02) == []
    assert reports_of(client.session, silent_s=limit_s + 0.02) == ["stalled", "resumed"]


def test_a_delayed_burst_counts_only_shortly() -> None:
    client = PacedClient()
    client.send(0.5)
    for _ in range(25):
        client.now_s += 0.02
        client.send(0.02)
    assert reports_of(client.session, silent_s=STALLED_AFTER_S + 0.02) == ["stalled", "resumed"]


@pytest.mark.parametrize(("paced", "expected"), [(True, ["stalled", "resumed"]), (False, [])])
def test_a_live_client_that_interrupts_has_stalled(paced: bool, expected: list[str]) -> None:
    session = make_session(paced=paced)
    reports: list[Progress] = []
    cast(Any, session.link).send = lambda message, _: reports.append(message)
    session.on_flush(6, 60.0)
    session.on_new_audio(60.1)
    assert [report.state for report in reports] == expected


def test_a_mouth_profile_that_does_not_fit_is_not_used() -> None:
    session = make_session(mouth_profile=b"not a profile")
    assert "the mouth profile is not used" in session.mouth_profile_error


def test_a_session_gets_the_lip_positions_of_its_mouth_profile() -> None:
    predictor = load_lip_predictor()
    profile = MouthProfile(
        scale=np.zeros(15, np.float32),
        offset=np.full(15, 77, np.float32),
        residual=np.zeros(predictor.residual_shape, np.float32),
    )
    session = make_session(mouth_profile=profile.to_bytes(predictor.digest))
    session.stream.accept_waveform(samples_of_file(VOWELS_FILE)[:16_000])
    recognizer().decode_streams([session.stream])
    results = session.new_results()
    frames = [result for result in results if isinstance(result, LipPositions)]
    assert len(frames) > 5
    assert {np.frombuffer(frame.values, "<f4")[0] for frame in frames} == {77.0}
    messages = list(session.published_messages(results))
    assert [message.sequence for message in messages] == [*range(1, len(messages) + 1)]


def take(
    session: RecognizerSession, *sequences: int, now_s: float = 0.0, **values: Any
) -> list[int]:
    """Return the messages that a session accepts."""
    messages = [chunk(number, **{"acknowledge": True, **values}) for number in sequences]
    return [message.sequence for message in messages if session.accept_in_order(message, now_s)]


def test_takes_audio_in_order_from_a_client_that_resends() -> None:
    session = make_session()
    assert take(session, 7, 8, 11, 12, 9, 10, 11) == [7, 8, 9, 10, 11]
    assert session.last_sequence == 11


def test_does_not_wait_for_a_client_that_resends_nothing() -> None:
    assert take(make_session(), 1, 4, acknowledge=False) == [1, 4]


def test_continues_after_a_gap_that_is_not_filled_in_time() -> None:
    session = make_session()
    assert take(session, 1, 4, now_s=5.0) == [1]
    assert take(session, 6, now_s=5.0 + 0.9 * RESEND_WAIT_S) == []
    assert take(session, 7, 8, now_s=5.0 + RESEND_WAIT_S) == [7, 8]


def test_does_not_wait_for_audio_from_before_an_interruption() -> None:
    session = make_session()
    assert take(session, 1, 2, now_s=5.0) == [1, 2]
    session.on_flush(6, 60.0)
    assert take(session, 3, 7, now_s=60.0) == [3, 7]  # 3 was on its way; 4 to 6 were never sent
    assert take(session, 8, 10, now_s=60.1) == [8], "a later gap is filled again"


def test_does_not_wait_before_the_end_of_an_interrupted_stream() -> None:
    session = make_session()
    assert take(session, 1, 2) == [1, 2]
    session.on_flush(6, 5.0)  # 3 to 5 were never sent; 6 ends the audio
    assert take(session, 6) == [6]


def test_after_the_end_a_replacement_needs_no_audio_message(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = make_session()
    assert take(session, 1, 2, 3) == [1, 2, 3]
    session.output_sequence = 40
    ended = Progress(session="s", media_time=960, state=AudioState.ENDED)
    monkeypatch.setattr(session.link, "acknowledge", lambda *_: [ended])
    session.on_acknowledge(Acknowledge(session="s", sequence=40), 0.0)
    assert session.replay_window.last_droppable_sequence == 3
