"""Sound through real processes: frames and phones equal those of the pipeline, for every client."""

import csv
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import soundfile
from kouxing_client import Client, FapFrame
from numpy.typing import NDArray

from kouxing.evaluation.lips.live_faces import live_events, live_frames
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.mono_audio import read_mono_16k
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import to_samples
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones import events
from kouxing.shared.phones.events import LipPositions
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.wire import speech
from kouxing.shared.wire.events import event_to_message
from tests.e2e.conftest import CommandRunner
from tests.e2e.streaming import StreamedSession, stream_audio
from tests.lips import LIPS
from tests.system import (
    BLOCK_NETWORK,
    CHAIN,
    DEMO,
    LIMIT_S,
    VOWELS_FILE,
    System,
    samples_of_file,
    start_python,
)

DELAY = round(SynthesizerConfig().delay_ms * 16)  # samples
OPEN_JAW = 2  # index of FAP 3
SENTENCE = samples_of_file(DEMO / "hello-female.wav")[:48000]
MOUTH = np.array(MOUTH_FAPS) - 1
LIPS_AND_JAW = [*range(2, 11), *range(50, 58)]  # without the corners' height, which shows feelings


def opening(frame: FapFrame) -> float:
    """Return how far lips and jaw are from rest, in FAP units."""
    return float(np.abs(np.frombuffer(frame.values, "<f4")[LIPS_AND_JAW]).max())


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[System]:
    with System(CHAIN, tmp_path_factory.mktemp("system"), BLOCK_NETWORK) as running:
        yield running


@pytest.fixture(scope="module")
def streamed(system: System) -> StreamedSession:
    return stream_audio(system.control, SENTENCE)


def test_phones_become_final_and_speech_starts_and_ends(streamed: StreamedSession) -> None:
    assert len(streamed.symbols) > 10
    assert {*streamed.symbols} <= {*load_inventory().phones}
    assert all({phone.index: phone.final for phone in streamed.phones}.values())
    states = [speech.active for speech in streamed.speech]
    assert (states[0], states[-1]) == (True, False)
    assert all(before != after for before, after in itertools.pairwise(states))


def test_the_sound_is_the_audio_that_was_sent(streamed: StreamedSession) -> None:
    sound = np.concatenate([np.frombuffer(sound.pcm, "<i2") for sound in streamed.sounds])
    np.testing.assert_allclose(sound / 32768, SENTENCE, atol=1e-4)


def test_a_flush_returns_to_rest_within_150_ms(client: Client) -> None:
    with client.open_session(encoding="f32le", paced=False) as session:
        streamed = StreamedSession(session)
        streamed.send(SENTENCE[:24000], chunk=8000)
        streamed.collect_until(lambda: streamed.times[-1:] >= [24000 - DELAY])
        assert opening(streamed.frames[-1]) > 50, "the mouth is open in mid-sentence"
        num_before = len(streamed.frames)
        session.flush()
        client.open_session().close()  # every service has processed control's messages
        session.push(np.zeros(8000, np.float32))
        streamed.collect_until(lambda: streamed.times[-1] >= 32000 - 3200)
    after = streamed.frames[num_before:]
    assert max(map(opening, after[8:])) < 1, "150 ms are 7.5 frames"


def test_a_flush_also_drops_audio_that_is_still_queued(client: Client) -> None:
    with client.open_session(encoding="f32le", paced=False) as session:
        streamed = StreamedSession(session)
        session.push(np.tile(SENTENCE, 20))  # more than the recognizer decodes before the flush
        flushed = session.media_time
        streamed.collect_until(lambda: streamed.frames)
        session.flush()
        client.open_session().close()  # every service has processed control's messages
        session.push(np.zeros(8000, np.float32))
        streamed.collect_until(lambda: streamed.times[-1:] >= [flushed + 8000 - 3200])
    before = [time for time in streamed.times if time <= flushed - 3200]
    assert max(before) < flushed / 4, "most of the audio was still queued"


def at_rate(samples: NDArray[np.float32], rate_hz: int) -> NDArray[np.float32]:
    positions = np.arange(len(samples) * rate_hz // 16000) * (16000 / rate_hz)
    resampled: NDArray[np.float32] = np.interp(positions, np.arange(len(samples)), samples).astype(
        np.float32
    )
    return resampled


@pytest.mark.parametrize(
    ("name", "rate_hz", "chunk"),
    [("lake-male", 16000, 97), ("bilabials-female", 44100, 1021), ("hello-male", 48000, 128)],
)
def test_services_send_the_frames_of_the_chain(
    system: System, name: str, rate_hz: int, chunk: int
) -> None:
    samples = at_rate(samples_of_file(DEMO / f"{name}.wav")[:32000], rate_hz)
    samples = samples[: len(samples) // 2 * 2 - 1]  # the sound ends within a slice of 20 ms
    streamed = stream_audio(system.control, samples, chunk=chunk, sample_rate_hz=rate_hz)
    pipeline = LivePipeline(load_model(), load_lip_model(), sample_rate_hz=rate_hz)
    frames = pipeline.accept_waveform(samples) + pipeline.input_finished()

    assert streamed.times == [to_samples(time_s) for time_s, _ in frames]
    np.testing.assert_array_equal(streamed.faps, np.array([faps for _, faps in frames]))
    assert streamed.faps[:, MOUTH].any()
    assert lip_positions_of(streamed) == [
        event_to_message(event) for event in pipeline.events if isinstance(event, LipPositions)
    ]
    assert streamed.lips
    recognized_phones = [event for event in pipeline.events if isinstance(event, events.Phone)]
    assert [
        (phone.index, phone.symbol, phone.media_time, phone.duration, phone.confidence, phone.final)
        for phone in streamed.phones
    ] == [
        (
            phone.index,
            phone.symbol,
            to_samples(phone.onset_s),
            to_samples(phone.duration_s),
            phone.confidence,
            phone.final,
        )
        for phone in recognized_phones
    ]


def lip_positions_of(streamed: StreamedSession) -> list[speech.LipPositions]:
    """Lip positions without session, epoch and sequence."""
    return [
        speech.LipPositions(
            media_time=lips.media_time,
            values=lips.values,
            delay_samples=lips.delay_samples,
            closure=lips.closure,
            lip_to_teeth=lips.lip_to_teeth,
        )
        for lips in streamed.lips
    ]


def test_evaluation_scores_the_mouth_of_the_chain() -> None:
    samples = samples_of_file(VOWELS_FILE)
    pipeline = LivePipeline(
        load_model(), LIPS, synthesizer=SynthesizerConfig(expressiveness=1.0, feeling=0.0)
    )
    frames = pipeline.accept_waveform(samples) + pipeline.input_finished()
    delay_s = SynthesizerConfig().delay_ms / 1e3
    live = live_events(load_model(), samples, None, [delay_s])
    scored = live_frames(LIPS, live[delay_s], delay_s)
    np.testing.assert_array_equal(scored[:, MOUTH], np.array([faps[MOUTH] for _, faps in frames]))
    assert scored[:, MOUTH].any()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Vowels, and a loud stereo recording at 44.1 kHz that ends within a word."""
    folder = tmp_path_factory.mktemp("recordings")
    samples = read_audio(DEMO / "lake-male.wav")[0][:, 0]
    times = np.arange(-8_000, 40_000, 16_000 / 44_100)  # 3 s, with a pause before the speech
    stereo = np.interp(times, np.arange(len(samples)), samples)[:, None] * [1.5, 0.4]
    soundfile.write(folder / "stereo.wav", stereo, 44100, subtype="FLOAT")
    return [VOWELS_FILE, folder / "stereo.wav"]


@pytest.fixture(scope="module")
def expected(recordings: list[Path]) -> dict[str, list[events.Phone]]:
    """The phones of each recording by its name, found by a single call."""
    model = load_model()
    return {path.name: recognize_recording(model, read_mono_16k(path)) for path in recordings}


def without_silence(phones: list[events.Phone]) -> list[events.Phone]:
    return [phone for phone in phones if phone.is_spoken]


def listen_line(phone: events.Phone) -> str:
    """Return a phone as ``kouxing listen`` prints it."""
    return f"{phone.onset_s:9.3f} s  {phone.duration_s:6.3f} s  {phone.symbol}"


def test_phones_and_render_return_the_phones_of_the_chain(
    command: CommandRunner,
    recordings: list[Path],
    expected: dict[str, list[events.Phone]],
    tmp_path: Path,
) -> None:
    assert command("phones", *recordings, "-o", tmp_path, "--format", "csv")[0] == 0
    for path in recordings:
        with (tmp_path / f"{path.stem}.csv").open() as file:
            rows = [[row[name] for name in row] for row in csv.DictReader(file)]
        for row, phone in zip(rows, expected[path.name], strict=True):
            assert row[1] == phone.symbol
            times = (phone.onset_s, phone.duration_s, phone.confidence)
            np.testing.assert_allclose([*map(float, row[2:5])], times, atol=5.1e-4)
    _, _, stderr = command("render", recordings[0], tmp_path / "live.csv", "--live")
    assert f", {len(without_silence(expected[recordings[0].name]))} phones" in stderr
    options = ("--size", "64x64", "--rate", "1", "-o", tmp_path)
    _, _, stderr = command("render", *recordings, *options)
    for path in recordings:
        count = len(without_silence(expected[path.name]))
        assert any(
            f"{path.stem}.mp4:" in text and text.endswith(f", {count} phones")
            for text in stderr.splitlines()
        ), stderr


def test_speak_and_listen_return_the_phones_of_the_chain(
    system: System,
    command: CommandRunner,
    recordings: list[Path],
    expected: dict[str, list[events.Phone]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("KOUXING_CONTROL", system.control.partition(" ")[0])
    for number, path in enumerate(recordings):
        name = f"same-{number}"
        listener = start_python(
            "-m", "kouxing", "listen", name, "--as", "phones", control=system.control
        )
        assert listener.stderr is not None
        assert name in listener.stderr.readline()
        pace = ["--fast"] if number else []
        phones = without_silence(expected[path.name])
        _, _, stderr = command("speak", path, "--session", name, *pace)
        assert f"session {name}: {len(phones)} phones in" in stderr
        output, log = listener.communicate(timeout=LIMIT_S)
        assert f"session {name} ended: {len(phones)} phones" in log
        assert output.splitlines() == [listen_line(phone) for phone in phones]
