"""The window model: Whisper's encoder on the last seconds, its file, its readout's training."""

from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch

from corpora.feature_cache import as_floats
from services.recognizer.acoustic.acoustic_model import AcousticModel, run_scoring_tasks
from services.recognizer.acoustic.load import load_model, model_path, with_lip_network
from services.recognizer.acoustic.model_file import read_archive, write_archive
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.acoustic.window import WindowModel
from services.recognizer.front_end.whisper_mel import WhisperMel
from services.recognizer.lips import lips_for
from services.recognizer.recognizer import Emission, Recognizer
from services.recognizer.speech_scores import FrameScores, SpeechScores, score_recording
from services.recognizer.stream import SpeechStream
from shared.audio_file import read_audio
from shared.errors import UserError
from shared.phones.events import LipFrame, Phone
from tests.tones import tones
from tests.unit.test_neural_training import write_corpus
from tests.whisper_folder import encoder_arrays, write_whisper
from training.neural import teacher
from training.neural.batches import Recording, Targets
from training.neural.network import Shape
from training.neural.teacher import WholeEncoder
from training.window import readout
from training.window.export import onnx_of
from training.window.labels import load_labels, save_labels
from training.window.readout import Readout, train_readout
from training.window.recipe import encode_by, train_window

pytestmark = [pytest.mark.unit, pytest.mark.usefixtures("one_thread")]

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
FRAMES = WhisperMel().accept_waveform(HELLO)
SMALL = partial(Shape, look_aheads=(), width=32, heads=2, layers=4, inner=48)
WINDOW, HOP = 60, 10


@cache
def networks(num_states: int) -> tuple[WholeEncoder, Readout]:
    torch.manual_seed(0)
    encoder = WholeEncoder(SMALL(num_states=num_states)).eval()
    with torch.no_grad():  # trained convolutions differ more than new ones
        encoder.first.weight *= 6
        encoder.second.weight *= 6
    return encoder, Readout(96, num_states).eval()


@cache
def window(look_ahead_ms: float = 10.0) -> WindowModel:
    shipped = load_model()
    assert isinstance(shipped, NeuralModel)
    model = WindowModel(
        topology=shipped.topology,
        network=onnx_of(*networks(shipped.topology.num_states), max_positions=WINDOW // 2),
        log_prior=shipped.log_prior,
        acoustic_scale=0.5,
        window_frames=WINDOW,
        hop_frames=HOP,
    )
    return model.with_look_ahead(look_ahead_ms)


def scores_of(model: WindowModel, frames: np.ndarray) -> np.ndarray:
    stream = model.stream()
    return np.concatenate([stream.accept(frames), stream.finish()])


# --- scores


@pytest.mark.parametrize("num_frames", [1, 24, 25, 60])
def test_onnxruntime_computes_what_pytorch_does(num_frames: int) -> None:
    encoder, reader = networks(180)
    frames = FRAMES[:num_frames].copy()
    frames[0, 0] = frames.max() - 3.0  # below the floor
    bands = np.maximum(frames, frames.max() - 2.0).T.copy()
    with torch.no_grad():
        features = encoder(torch.from_numpy(bands)[None])
        expected = reader(features)[0].numpy()
    found = encode_by(encoder)(frames)
    deviation = float(features.std())
    np.testing.assert_allclose(found, features[0].numpy(), atol=0.1 * deviation)
    rows = window().session.run(frames)
    assert rows.shape == (num_frames, 180)
    np.testing.assert_allclose(rows, expected[:num_frames], atol=0.1)


@pytest.mark.parametrize("look_ahead_ms", [0.0, 10.0, 60.0, 200.0])
def test_scores_come_in_time(look_ahead_ms: float) -> None:
    model = window(look_ahead_ms)
    stream = model.stream()
    look_ahead = int(look_ahead_ms) // 10
    right = max(look_ahead, 15)
    assert stream.look_ahead_frames == right + HOP - 1
    num_settled = 0
    for number in range(1, len(FRAMES) + 1):
        num_settled += len(stream.accept(FRAMES[number - 1 : number]))
        newest = number // HOP * HOP
        assert num_settled == max(0, newest - right)
        assert num_settled + len(stream.provisional) == max(0, newest - look_ahead)
    assert num_settled + len(stream.finish()) == len(FRAMES)
    assert len(stream.provisional) == 0


@pytest.mark.parametrize("num_frames", [0, 1, 2, 9, 10, 11, 29, 30])
def test_every_frame_of_a_segment_is_scored_once(num_frames: int) -> None:
    for look_ahead_ms in (0.0, 200.0):
        stream = window(look_ahead_ms).stream()
        for _ in range(2):
            rows = [*stream.accept(FRAMES[:num_frames]), *stream.finish()]
            assert len(rows) == num_frames
        assert len(stream.finish()) == 0


def test_a_frame_is_settled_by_the_first_window_with_enough_after_it() -> None:
    model = window(30.0)
    found = scores_of(model, FRAMES)
    for frame in (0, 4, 5, 54, 55, 64, 65, 100):
        end = -(-(frame + 1 + 15) // HOP) * HOP
        start = max(0, end - WINDOW)
        row = model.session.run(FRAMES[start:end])[frame - start]
        np.testing.assert_array_equal(found[frame], np.float32(0.5) * (row - model.log_prior))


def test_provisional_scores_are_those_of_the_newest_window() -> None:
    model = window(20.0)
    stream = model.stream()
    for end in range(10, 110, 10):
        stream.accept(FRAMES[end - 10 : end])
        frames = FRAMES[max(0, end - WINDOW) : end]
        expected = model.score_window(frames)[len(frames) - min(end, 15) : -2]
        np.testing.assert_array_equal(stream.provisional, expected)


def test_scores_are_the_same_in_any_chunks_and_any_company() -> None:
    model = window(60.0)
    expected = scores_of(model, FRAMES)
    streams = [model.stream() for _ in range(3)]
    rows: list[list[np.ndarray]] = [[] for _ in streams]
    for start in range(0, len(FRAMES), 7):
        company = [n for n in range(3) if start % (7 * (n + 1)) == 0]  # chunks of 7, 14, 21
        work = [(streams[n], FRAMES[start : start + 7 * (n + 1)]) for n in company]
        for n, scores in zip(company, model.score(work), strict=True):
            rows[n].append(scores)
    for stream, found in zip(streams, rows, strict=True):
        np.testing.assert_array_equal(np.concatenate([*found, stream.finish()]), expected)


def test_sessions_scored_together_give_what_each_gives_alone() -> None:
    model = window()
    sounds = [HELLO, HELLO[8000:], np.zeros(4000, np.float32)]
    streams = [SpeechScores(model, 16_000) for _ in sounds]
    tasks = [stream.process(sound) for stream, sound in zip(streams, sounds, strict=True)]
    together = run_scoring_tasks(model, tasks)
    ends = run_scoring_tasks(model, [stream.finish() for stream in streams])
    for sound, first, last in zip(sounds, together, ends, strict=True):
        alone = score_recording(model, sound, 16_000)
        assert len(first + last) == len(alone)
        for found, expected in zip(first + last, alone, strict=True):
            if isinstance(found, FrameScores) and isinstance(expected, FrameScores):
                np.testing.assert_array_equal(found.settled, expected.settled)
                np.testing.assert_array_equal(found.provisional, expected.provisional)
            else:
                assert found == expected
    assert together[0]


def test_phones_are_the_same_in_any_chunks() -> None:
    def phones(chunk: int) -> list[Emission]:
        recognizer = Recognizer(window(), sample_rate_hz=16_000, min_confidence=0.0)
        pieces = np.split(HELLO, range(chunk, len(HELLO), chunk))
        events = [event for piece in pieces for event in recognizer.accept_waveform(piece)]
        return events + recognizer.input_finished()

    expected = phones(len(HELLO))
    assert len(expected) > 5
    assert phones(160) == phones(1111) == expected


def test_a_look_ahead_is_a_number_of_frames() -> None:
    assert window().look_ahead_frames == 1
    for refused in (5.0, -10.0, 310.0, float("nan")):
        with pytest.raises(UserError, match=r"look_ahead_ms is .*; give 0, 10, 20"):
            window().with_look_ahead(refused)


def test_the_lips_follow_the_causal_network_beside_it() -> None:
    assert lips_for(window()) is None
    model, neural = with_lip_network(window()), load_model()
    assert with_lip_network(neural) is neural
    lips = lips_for(model)
    assert lips is not None

    def frames_and_phones(model: AcousticModel) -> tuple[list[LipFrame], list[Phone]]:
        stream = SpeechStream(model, lips=lips, face_delay_s=0.06)
        tasks = [stream.process([(0, HELLO)]), SpeechStream(model).process([(0, HELLO[4000:])])]
        events = [*run_scoring_tasks(model, tasks)[0], *stream.input_finished()]
        return (
            [event for event in events if isinstance(event, LipFrame)],
            [event for event in events if isinstance(event, Phone)],
        )

    found_frames, found_phones = frames_and_phones(model)
    expected_frames, neural_phones = frames_and_phones(neural)
    assert len(found_frames) > 40
    for found, expected in zip(found_frames, expected_frames, strict=True):
        assert (found.time_s, found.delay_s) == (expected.time_s, expected.delay_s)
        np.testing.assert_array_equal(found.faps, expected.faps)
    assert found_phones == frames_and_phones(window())[1] != neural_phones


# --- the file


def test_saved_and_loaded_scores_are_the_same(tmp_path: Path) -> None:
    window().save(tmp_path / "window.npz")
    again = load_model(tmp_path / "window.npz", look_ahead_ms=60.0)
    assert isinstance(again, WindowModel)
    np.testing.assert_array_equal(scores_of(again, FRAMES), scores_of(window(60.0), FRAMES))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": np.zeros(100, np.uint8)}, "network cannot be read"),
        ({"hop_frames": np.array(0)}, "windows have 60 frames, every 0"),
        ({"hop_frames": np.array(31)}, "windows have 60 frames, every 31"),
        ({"window_frames": np.array(251)}, "windows have 251 frames"),
        ({"window_frames": np.array(100)}, "does not run"),  # more than its positions
        ({"log_prior": np.zeros(7, np.float32)}, "log_prior has shape"),
        ({"acoustic_scale": np.array(np.nan, np.float32)}, "not finite"),
        ({"network": read_archive(model_path("neural")).arrays["network"]}, "has the inputs"),
    ],
)
def test_files_are_checked(change: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    path = tmp_path / "window.npz"
    window().save(path)
    write_archive(path, {**read_archive(path).arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


def test_a_network_of_other_states_or_values_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "window.npz"
    window().save(path)
    arrays = read_archive(path).arrays
    encoder, reader = networks(178)
    write_archive(path, {**arrays, "network": onnx_of(encoder, reader, WINDOW // 2)})
    with pytest.raises(UserError, match=r"its network scores \(60, 178\)"):
        load_model(path)
    encoder, reader = networks(180)
    broken = Readout(96, 180).eval()
    with torch.no_grad():
        broken.output.bias[3] = float("nan")
    write_archive(path, {**arrays, "network": onnx_of(encoder, broken, WINDOW // 2)})
    with pytest.raises(UserError, match="are not finite"):
        load_model(path)


# --- training


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readout, "_INNER", 48)
    monkeypatch.setattr(readout, "_GRU", 24)
    monkeypatch.setattr(readout, "BATCH_S", 3)
    monkeypatch.setattr(readout, "MAX_WINDOW_FRAMES", 80)
    monkeypatch.setattr(readout, "_FIXED_FRAMES", 50)
    monkeypatch.setattr(readout, "_KEEP_EVERY", 4)


@pytest.mark.usefixtures("quick")
def test_the_readout_learns_which_tone_is_when_and_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def as_it_is(recording: Recording, _rng: np.random.Generator) -> tuple[np.ndarray, Targets]:
        return WhisperMel().accept_waveform(as_floats(recording.samples)), recording.targets

    monkeypatch.setattr(readout, "augment", as_it_is)
    encode = encode_by(networks(6)[0])
    recordings = [tones(seed) for seed in range(12)]
    lines: list[str] = []

    def train(num_steps: int, name: str) -> Readout:
        return train_readout(
            encode, recordings, 6,
            seed=0, num_steps=num_steps, kept=tmp_path / name, report=lines.append,
        )  # fmt: skip

    whole = train(120, "whole")
    unseen = tones(100)
    frames = WhisperMel().accept_waveform(as_floats(unseen.samples))
    with torch.no_grad():
        found = whole(torch.from_numpy(encode(frames))[None])[0, : len(frames)]
    assert np.mean(found.argmax(dim=-1).numpy() == unseen.targets.states[:, 0]) > 0.93
    assert lines[-1].startswith("step 120: ")

    def interrupted(line: str) -> None:
        if line.startswith("step 8:"):
            raise KeyboardInterrupt

    first = train(12, "first").state_dict()
    with pytest.raises(KeyboardInterrupt):
        train_readout(
            encode, recordings, 6, seed=0, num_steps=12, kept=tmp_path / "second",
            report=interrupted,
        )  # fmt: skip
    second = train(12, "second").state_dict()
    assert "going on after step 4" in lines
    for name, weights in first.items():
        torch.testing.assert_close(second[name], weights, rtol=0, atol=0)


def test_labels_are_kept(tmp_path: Path) -> None:
    recordings = [tones(0), tones(1)]
    save_labels(tmp_path / "labels.npz", recordings)
    for before, after in zip(recordings, load_labels(tmp_path / "labels.npz"), strict=True):
        np.testing.assert_array_equal(after.samples, before.samples)
        np.testing.assert_array_equal(after.targets.states, before.targets.states)
        np.testing.assert_array_equal(after.targets.probs, before.targets.probs)
        assert after.weight == before.weight


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_the_recipe_writes_model_and_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("training.neural.initial_network.Shape", SMALL)
    monkeypatch.setattr(teacher, "_NUM_STEPS", 2)
    corpus = write_corpus(tmp_path / "corpus", {"a": HELLO, "b": HELLO, "d": HELLO})
    whisper = write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6))
    lines: list[str] = []
    outputs = [tmp_path / f"{name}.npz" for name in ("window", "again")]
    for output in outputs:
        train_window(
            [corpus], output, whisper=whisper, untranscribed=[corpus],
            seed=1, num_steps=4, report=lines.append,
        )  # fmt: skip
    assert outputs[0].read_bytes() == outputs[1].read_bytes()
    model = load_model(outputs[0])
    assert isinstance(model, WindowModel)
    shipped = load_model()
    np.testing.assert_array_equal(model.topology.log_stay, shipped.topology.log_stay)
    assert "5 of 5 recordings labelled by the teacher" in lines
    card = outputs[0].with_suffix(".md").read_text()
    assert "on 5 recordings of 0 minutes drawn from those below" in card
    assert "CC0-1.0" in card
    left = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert left == {"window.npz", "window.md", "again.npz", "again.md"}


def test_only_a_neural_model_can_be_the_start(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is no neural model; give one that"):
        train_window([], tmp_path / "w.npz", whisper=tmp_path, start=model_path("gmm"))
