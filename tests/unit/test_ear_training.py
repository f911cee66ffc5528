"""Training of the small ear: its teachers, its batches, its network, the recipe."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from kouxing.corpora.feature_cache import as_integers
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.onnx_session import open_network
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.training.ear import batches, recipe, targets, teachers
from kouxing.training.ear.batches import Material, batch_of, inputs_of
from kouxing.training.ear.export import load_ear, onnx_of
from kouxing.training.ear.network import Ear
from kouxing.training.ear.recipe import Sources, load_teachers, train_ear
from kouxing.training.ear.singing import sing
from kouxing.training.ear.targets import PITCH, VOICE, Columns, Piece, Voice
from kouxing.training.ear.teachers import POSITION_SAMPLES
from kouxing.training.neural import optimizer
from kouxing.training.neural.network import Shape
from tests.system import DEMO
from tests.unit.test_neural_training import write_corpus
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
NUM_PHONES = 3
COLUMNS = Columns(NUM_PHONES)


@pytest.fixture
def whisper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(teachers, "Shape", partial(Shape, width=64, heads=2, inner=48))
    return write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6, width=64))


def piece(samples: np.ndarray, voice: Voice = Voice.SPEECH) -> Piece:
    """Make a piece whose pitch is the number of the position."""
    num_positions = len(samples) // POSITION_SAMPLES
    rows = np.zeros((num_positions, COLUMNS.lips.stop), np.float16)
    rows[:, PITCH], rows[:, VOICE] = np.arange(num_positions), voice
    rows[:, COLUMNS.phones] = 1 / NUM_PHONES
    return Piece(as_integers(samples[: POSITION_SAMPLES * num_positions]), rows, 1.0)


def test_teachers_give_the_values_of_the_live_networks(whisper: Path) -> None:
    networks, _ = load_teachers(whisper)
    outputs = networks.compute_targets(as_integers(HELLO))
    num_positions = len(outputs.phones)
    assert {len(getattr(outputs, name)) for name in outputs.__slots__} == {num_positions}
    np.testing.assert_allclose(outputs.phones.sum(axis=1), 1, atol=1e-3)
    model = load_model(model_path("neural"))
    assert isinstance(model, NeuralModel)
    stream = model.create_stream(keep_positions=True)
    stream.score(WhisperMel().accept_waveform(HELLO))
    live = [position.values[-2:].ravel() for position in stream.positions]
    assert np.corrcoef(np.ravel(live), np.ravel(outputs.causal[: len(live)]))[0, 1] > 0.98
    assert len(networks.causal_values(torch.zeros(1, 3_201, 80))) == 1_600  # over 30 s
    inventory = model.inventory
    assert {inventory.phones[phone] for phone in outputs.phones.argmax(axis=1)} >= {"n", "i", "h"}


def test_sings_and_holds_speech() -> None:
    copies = [sing(HELLO, 75, np.random.default_rng(seed)) for seed in range(4)]
    melodies = [copy for copy in copies if copy and copy.is_sung.all()]
    holds = [copy for copy in copies if copy and not copy.is_sung.all()]
    assert melodies
    assert holds
    for copy in (*melodies, *holds):
        assert (np.diff(copy.source) >= 0).all()
        assert len(copy.samples) > len(HELLO)
        assert abs(len(copy.samples) / POSITION_SAMPLES - len(copy.source)) < 2
    held = holds[0].source[holds[0].is_sung]
    assert len(held) >= 50
    assert np.ptp(held) == 0


def test_does_not_sing_silence() -> None:
    assert sing(np.zeros(16_000, np.float32), 50, np.random.default_rng(0)) is None


def test_targets_move_with_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 6)
    monkeypatch.setattr(batches, "_PAUSE_PROB", 0.0)
    material = Material([piece(np.resize(HELLO, 128_000))], [as_integers(HELLO)])
    inputs, rows = batch_of(material, 0, 1)
    assert inputs.shape[:2] == rows.shape[:2] == (6, batches.NUM_POSITIONS)
    again, _ = batch_of(material, 0, 1)
    assert torch.equal(inputs, again)
    speeds = {round(float(excerpt[100:200, PITCH].diff().mean()), 2) for excerpt in rows}
    assert len(speeds) > 2
    assert all(0.8 < speed < 1.2 for speed in speeds)


def test_pauses_have_no_voice_and_no_other_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "_PAUSE_PROB", 1.0)
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 3)
    _, rows = batch_of(Material([piece(HELLO)], [as_integers(HELLO)]), 0, 0)
    paused = rows[..., COLUMNS.causal].isnan().all(dim=-1)
    assert paused.any()
    assert (rows[..., VOICE][paused] == Voice.NONE).all()
    assert (rows[..., VOICE][~paused] == Voice.SPEECH).all()


def test_loss_leaves_out_unknown_targets() -> None:
    ear = Ear(NUM_PHONES, width=8)
    inputs = torch.randn(2, 9, 160)
    rows = torch.randn(2, 9, COLUMNS.lips.stop)
    rows[..., VOICE] = 1
    rows[:, 3:5, :VOICE] = rows[:, 3:5, VOICE + 1 :] = torch.nan
    loss = ear.loss(inputs, rows)
    loss.backward()  # type: ignore[no-untyped-call]
    assert loss.isfinite()
    gradients = [weight.grad for weight in ear.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)
    changed = inputs.clone()
    changed[:, -1] += 1  # the newest position affects only the targets of now
    before, after = (ear.split(ear(values)) for values in (inputs, changed))
    assert torch.equal(before.voice[:, :-1], after.voice[:, :-1])


def test_exported_steps_follow_pytorch() -> None:
    torch.manual_seed(0)
    ear = Ear(NUM_PHONES, width=16).eval()
    session = open_network(onnx_of(ear).tobytes())
    inputs = inputs_of(HELLO)[:20]
    with torch.no_grad():
        expected = ear.split(ear(torch.from_numpy(inputs)[None]))
    state = np.zeros((2, 32), np.float32)
    for number, row in enumerate(inputs):
        names = ["voice", "features", "new_state"]
        frames = np.stack([row, inputs[0]])
        voice, features, state = session.run(names, {"frames": frames, "state": state})
        np.testing.assert_allclose(voice[0], expected.voice[0, number].softmax(-1), atol=0.02)
        np.testing.assert_allclose(features[0, :128], expected.causal[0, number], atol=0.05)


def write_sounds(folder: Path) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(0)
    lines = ["path\tkind\tlicence"]
    for kind in ("babble", "laughter"):
        soundfile.write(folder / f"{kind}.wav", rng.normal(0, 0.1, 32_000), 16_000)
        lines.append(f"{kind}.wav\t{kind}\tCC0")
    (folder / "manifest.tsv").write_text("\n".join(lines) + "\n")
    return folder


def test_trains_resumes_and_writes_a_model(
    tmp_path: Path, whisper: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "NUM_EXCERPTS", 2)
    monkeypatch.setattr(batches, "NUM_POSITIONS", 30)
    monkeypatch.setattr(targets, "CHUNK_SIZE", 2)
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 1)
    monkeypatch.setattr(recipe, "_FIRST_CHUNKS", 1)
    corpus = write_corpus(tmp_path / "corpus", {"a": HELLO, "b": HELLO, "d": HELLO})
    sources = Sources(
        corpora=[corpus], untranscribed=[corpus], sounds=[write_sounds(tmp_path / "sounds")]
    )
    output = tmp_path / "ear.npz"
    lines: list[str] = []
    train = partial(train_ear, whisper=whisper, report=lines.append)
    train(sources, output, num_steps=2)
    train(sources, output, num_steps=3)
    assert "resuming after step 2" in lines
    assert sum("held-out loss" in line for line in lines) == 1
    for path in (output, output.with_suffix(".checkpoint.pt")):
        assert open_network(load_ear(path).tobytes()).get_inputs()[0].name == "frames"
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"no checkpoint")
    with pytest.raises(UserError, match="is not a small ear"):
        load_ear(broken)
    assert "3 steps of" in output.with_suffix(".md").read_text()
    with pytest.raises(UserError, match="targets of other recordings or models; delete it"):
        train(Sources(corpora=[corpus], sounds=sources.sounds), output, num_steps=3)


@pytest.mark.parametrize(("name", "problem"), [("a", "no music or noise"), ("d", "no usable rec")])
def test_needs_speech_and_sounds(tmp_path: Path, whisper: Path, name: str, problem: str) -> None:
    corpus = write_corpus(tmp_path / "corpus", {name: HELLO})
    with pytest.raises(UserError, match=problem):
        train_ear(Sources(corpora=[corpus]), tmp_path / "ear.npz", whisper=whisper)
