"""Training of the audio encoder: its teachers, its batches, its network, the recipe."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from onnx import TensorProto, helper

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.encoder import LIP_DELAYS_S, VoiceKind, load_encoder
from kouxing.services.recognizer.acoustic.onnx_session import create_inference_session
from kouxing.services.recognizer.lips.lip_predictor import NUM_OUTPUTS
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import UserError
from kouxing.training.encoder import batches, lip_teacher, recipe, targets, trainer
from kouxing.training.encoder.batches import BatchSource, draw_batch, draw_excerpts, network_inputs
from kouxing.training.encoder.export import export_onnx, rebuild_encoder, save_encoder
from kouxing.training.encoder.network import NUM_FEATURES, NUM_LIPS, AudioEncoder
from kouxing.training.encoder.recipe import Sources, read_sources, refine_encoder, train_encoder
from kouxing.training.encoder.refinement import imitation_loss, refine
from kouxing.training.encoder.targets import PITCH, VOICE, Piece, SourceRecording, TargetColumns
from kouxing.training.encoder.teachers import ENCODER_FRAME_SAMPLES
from kouxing.training.networks import optimizer
from kouxing.training.networks import whisper as whisper_weights
from kouxing.training.networks.network import EncoderShape
from kouxing.training.networks.onnx_graph import Graph
from tests.corpora import interrupt, write_noises, write_speech
from tests.lip_clips import clip_name_for, write_training_clip
from tests.system import HELLO
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

NUM_PHONES = 3
COLUMNS = TargetColumns(NUM_PHONES)


@pytest.fixture
def whisper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(
        whisper_weights, "EncoderShape", partial(EncoderShape, width=64, heads=2, inner=48)
    )
    return write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6, width=64))


@pytest.fixture(autouse=True)
def _short_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 2)
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 1)


def small_sources(folder: Path) -> partial[Sources]:
    """Write recordings, noises and a clip; return the function that reads them."""
    (folder / "clips").mkdir()
    write_training_clip(folder / "clips", clip_name_for("train"), "anna", "CC0")
    corpus = write_speech(folder / "corpus", {"a": HELLO, "b": HELLO, "d": HELLO})
    sounds = [write_noises(folder / "sounds")]
    return partial(read_sources, [corpus], folder / "clips", sounds=sounds, any_license=False)


def assert_resumed(output: Path, log: str) -> None:
    """Check a model that was trained in two runs."""
    assert "resuming after step 2" in log
    assert load_encoder(output).num_features == NUM_FEATURES
    assert "3 steps of" in output.with_suffix(".md").read_text()
    assert {*output.parent.glob("encoder*")} == {output, output.with_suffix(".md")}


def piece(samples: np.ndarray, voice: VoiceKind = VoiceKind.SPEECH) -> Piece:
    """Make a piece whose pitch and lips are the number of the position."""
    num_positions = len(samples) // ENCODER_FRAME_SAMPLES
    rows = np.zeros((num_positions, COLUMNS.lips.start + NUM_OUTPUTS), np.float16)
    rows[:, PITCH], rows[:, VOICE] = np.arange(num_positions), voice
    rows[:, COLUMNS.lips] = np.arange(num_positions)[:, None]
    rows[:, COLUMNS.phones] = 1 / NUM_PHONES
    return Piece(as_integers(samples[: ENCODER_FRAME_SAMPLES * num_positions]), rows, 1.0)


def test_lips_lag_by_their_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 1)
    monkeypatch.setattr(batches, "_PAUSE_PROB", 0.0)
    monkeypatch.setattr(batches, "change_speed", lambda samples, _: (samples, 1.0))
    batch_source = BatchSource(
        [piece(np.resize(HELLO, 128_000))], [as_integers(HELLO)], COLUMNS, background_only_prob=0.0
    )
    _, rows = draw_batch(batch_source, 1)
    lips = rows[0, 100, COLUMNS.lips].reshape(-1, NUM_OUTPUTS)[:, 0] - rows[0, 100, PITCH]
    # A position's audio ends 45 ms after its start, and the target of row 0 is at 20 ms.
    np.testing.assert_allclose(lips, (0.045 - np.array(LIP_DELAYS_S)) / 0.02 - 1, atol=0.51)


@pytest.mark.parametrize("babble_only_prob", [0.0, 1.0])
def test_background_voices_alone_are_not_a_voice(
    babble_only_prob: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 1)
    monkeypatch.setattr(batches, "disturb", lambda sound, _: sound)
    silence = np.zeros(16_000, np.int16)
    batch_source = BatchSource([piece(HELLO)], [silence], COLUMNS, 1.0, babble_only_prob)
    (excerpt,) = draw_excerpts(batch_source, 0)
    assert bool((np.abs(excerpt.disturbed) > 0.001).any()) is (babble_only_prob == 1.0)
    assert (excerpt.targets[:, VOICE] == VoiceKind.NONE).all()


def test_integer_products_are_exact_on_every_processor() -> None:
    graph = Graph()
    weights = {"sum.weight": np.ones((3, 64), np.float32), "sum.bias": np.zeros(3, np.float32)}
    graph.node("Identity", [graph.product("rows", weights, "sum")], "sums")
    file = graph.file(
        "sums",
        [helper.make_tensor_value_info("rows", TensorProto.FLOAT, [2, 64])],
        [helper.make_tensor_value_info("sums", TensorProto.FLOAT, [2, 3])],
    )
    session = create_inference_session(file.tobytes())
    (sums,) = session.run(None, {"rows": np.ones((2, 64), np.float32)})
    np.testing.assert_allclose(sums, 64, rtol=1e-5)


def test_exported_steps_follow_pytorch() -> None:
    torch.manual_seed(0)
    encoder = AudioEncoder(NUM_PHONES, width=16).eval()
    session = create_inference_session(export_onnx(encoder).tobytes())
    inputs = network_inputs(HELLO)[:20]
    with torch.no_grad():
        expected = encoder.split(encoder(torch.from_numpy(inputs)[None]))
    state = np.zeros((2, 32), np.float32)
    for number, row in enumerate(inputs):
        names = ["voice", "features", "new_state"]
        frames = np.stack([row, inputs[0]])
        voice, features, state = session.run(names, {"frames": frames, "state": state})
        np.testing.assert_allclose(voice[0], expected.voice[0, number].softmax(-1), atol=0.02)
        np.testing.assert_allclose(features[0, :128], expected.early[0, number], atol=0.05)


def test_trains_resumes_and_writes_a_model(
    tmp_path: Path,
    whisper: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(batches, "NUM_ENCODER_FRAMES", 30)
    monkeypatch.setattr(targets, "CHUNK_SIZE", 2)
    monkeypatch.setattr(lip_teacher, "NUM_EPOCHS", 1)
    sources, output = small_sources(tmp_path), tmp_path / "encoder.npz"
    write_training_clip(tmp_path / "clips", clip_name_for("choice"), "berta", "MIT")
    train = partial(train_encoder, output=output, whisper=whisper)
    all_sources = sources(untranscribed=[tmp_path / "corpus"])
    interrupt(recipe, "save_encoder", partial(train, all_sources, num_steps=2))
    with pytest.raises(UserError, match="targets of other recordings or models; delete it"):
        train(sources(untranscribed=[]), num_steps=3)
    train(all_sources, num_steps=3)
    assert_resumed(output, capsys.readouterr().err)


def test_rebuilds_an_exported_encoder(tmp_path: Path) -> None:
    torch.manual_seed(0)
    encoder = AudioEncoder(NUM_PHONES, width=16)
    save_encoder(tmp_path / "encoder.npz", encoder)
    inputs = torch.from_numpy(network_inputs(HELLO)[None, :20])
    with torch.no_grad():
        expected, rebuilt = encoder(inputs), rebuild_encoder(tmp_path / "encoder.npz")(inputs)
    np.testing.assert_allclose(rebuilt, expected, atol=0.01)


@pytest.mark.parametrize("kind", [VoiceKind.NONE, VoiceKind.SUNG])
def test_known_kinds_of_voice_replace_those_of_the_teacher(kind: VoiceKind) -> None:
    torch.manual_seed(0)
    encoder = AudioEncoder(NUM_PHONES, width=16)
    inputs = torch.from_numpy(network_inputs(np.resize(HELLO, 48_000))[None, :100])
    voice, deviation = torch.full((1, 100), torch.nan), torch.ones(NUM_LIPS)
    voice[:, 40:60] = kind
    rates = []
    for _ in range(2):
        loss = imitation_loss(encoder, encoder, deviation, inputs, inputs, voice)
        rates.append(torch.autograd.grad(loss, encoder.output.bias)[0].abs())
        voice[:] = torch.nan
    logits = slice(NUM_FEATURES + NUM_PHONES, NUM_FEATURES + NUM_PHONES + len(VoiceKind))
    known, unknown = rates
    assert known[logits].argmax() == kind
    assert unknown[logits].max() < 1e-6
    assert known[:NUM_FEATURES].max() < 1e-6


def test_refined_weights_are_averaged_with_the_first_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add_one(network: AudioEncoder, *_: object, **__: object) -> AudioEncoder:
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(1.0)
        return network

    monkeypatch.setattr(trainer, "optimize", add_one)
    torch.manual_seed(0)
    teacher = AudioEncoder(NUM_PHONES, width=16)
    refined = refine(
        teacher,
        [SourceRecording("hello", lambda: as_integers(HELLO), 1.0)],
        [as_integers(HELLO)],
        RowErrors(),
        num_steps=1,
        samples_path=tmp_path / "samples.npz",
        checkpoint=tmp_path / "checkpoint.pt",
    )
    gains = {
        name: value - teacher.state_dict()[name] for name, value in refined.state_dict().items()
    }
    sung = NUM_FEATURES + NUM_PHONES + VoiceKind.SUNG
    assert gains["output.bias"][sung] == pytest.approx(0.6 + 1.5)
    gains["output.bias"][sung] = 0.6
    for gain in gains.values():
        np.testing.assert_allclose(gain, 0.6, atol=1e-5)


def test_refines_resumes_and_writes_a_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torch.manual_seed(0)
    start, output = tmp_path / "start.npz", tmp_path / "encoder.npz"
    save_encoder(start, AudioEncoder(NUM_PHONES, width=16))
    sources = small_sources(tmp_path)(untranscribed=[])
    train = partial(refine_encoder, sources, output, start=start)
    interrupt(recipe, "save_encoder", partial(train, num_steps=2))
    train(num_steps=3)
    assert_resumed(output, capsys.readouterr().err)


@pytest.mark.parametrize(("name", "problem"), [("a", "no music or noise"), ("d", "no usable rec")])
def test_training_needs_speech_and_sounds(tmp_path: Path, name: str, problem: str) -> None:
    corpus = write_speech(tmp_path / "corpus", {name: HELLO})
    with pytest.raises(UserError, match=problem):
        read_sources([corpus], tmp_path, [], [], any_license=False)
