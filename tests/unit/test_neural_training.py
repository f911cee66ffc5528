"""Whisper's weights, augmentation, and the training of the network."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.network import WINDOW
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.training.blocks import batches as blocks
from kouxing.training.neural import teacher
from kouxing.training.neural.export import onnx_of
from kouxing.training.neural.initial_network import load_whisper
from kouxing.training.neural.network import Network, Shape
from kouxing.training.neural.optimizer import cross_entropy
from kouxing.training.neural.recipe import train_neural
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
SMALL = partial(Shape, width=32, heads=2, layers=2, inner=48)
SHAPE = SMALL(num_states=6, look_aheads=(1, 3, 6))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


# --- Whisper's weights


def floats(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def test_loads_whispers_weights(tmp_path: Path) -> None:
    arrays = encoder_arrays()
    other = {"decoder/projection/weight": np.zeros((4, 4), np.float16)}
    network = Network(SHAPE)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    load_whisper(network, write_whisper(tmp_path, {**other, **arrays}))
    attention, forward = "layer_1/self_attention", "layer_1/ffn"
    pairs = {
        "first": "conv1",
        "second": "conv2",
        "layers.1.attention_norm": f"{attention}/layer_norm",
        "layers.1.query_key_value": f"{attention}/linear_0",
        "layers.1.attended": f"{attention}/linear_1",
        "layers.1.inner_norm": f"{forward}/layer_norm",
        "layers.1.inner": f"{forward}/linear_0",
        "layers.1.outer": f"{forward}/linear_1",
    }
    after = network.state_dict()
    for ours, theirs in pairs.items():
        kinds = ("gamma", "beta") if "norm" in theirs else ("weight", "bias")
        for kind, of_file in zip(("weight", "bias"), kinds, strict=True):
            expected = arrays[f"encoder/{theirs}/{of_file}"].astype(np.float32)
            np.testing.assert_array_equal(floats(after[f"{ours}.{kind}"]), expected)
    for name in after:
        assert torch.equal(after[name], before[name]) == name.startswith(("norm", "outputs"))


def test_rejects_files_of_other_kinds_and_sizes(tmp_path: Path) -> None:
    def refused(message: str) -> None:
        with pytest.raises(UserError, match=message) as error:
            load_whisper(Network(SHAPE), tmp_path)
        assert str(tmp_path / "model.bin") in str(error.value)

    write_whisper(tmp_path, encoder_arrays(width=64))
    refused("64 x 80 x 3 instead of 32 x 80 x 3; give the folder of a Whisper model of width 32")
    write_whisper(tmp_path, encoder_arrays(num_layers=1))
    refused("lacks encoder/layer_1")
    write_whisper(tmp_path, encoder_arrays(), version=3)
    refused("its version 3 is too old")
    quantized = {"encoder/conv1/weight": np.ones((32, NUM_MELS, 3), np.int8)}
    write_whisper(tmp_path, encoder_arrays() | quantized)
    refused("conv1/weight is quantized")
    (tmp_path / "model.bin").write_bytes(b"")
    refused("not a Whisper model")


def write_corpus(folder: Path, sounds: dict[str, np.ndarray]) -> Path:
    """Recordings of one text; those whose name begins with d are for dev."""
    folder.mkdir(exist_ok=True)
    header = "utt_id\tpath\tspeaker\tlicence\tsplit\tseconds\tpinyin\n"
    rows = ""
    for name, sound in sounds.items():
        soundfile.write(folder / f"{name}.wav", sound, 16_000)
        split = "dev" if name.startswith("d") else "train"
        pinyin = "ni3 hao3 huan1 ying2 lai2 dao4"
        rows += f"{name}\t{name}.wav\tS\tCC0-1.0\t{split}\t1.5\t{pinyin}\n"
    (folder / "manifest.tsv").write_text(header + rows, encoding="utf-8")
    return folder


# --- the network


def test_onnxruntime_computes_what_pytorch_does() -> None:
    torch.manual_seed(0)
    network = Network(SMALL(num_states=180, look_aheads=(2, 7))).eval()
    rng = np.random.default_rng(0)
    frames = rng.normal(0, 0.5, (2 * WINDOW + 21, NUM_MELS)).astype(np.float32)
    for layer, look_ahead in enumerate(network.shape.look_aheads):
        with torch.no_grad():
            hidden = network(torch.from_numpy(frames)[None])
            rows = network.log_posteriors(hidden, layer)[0].flatten(0, 1).numpy()
        model = NeuralModel(
            topology=load_model().topology,
            network=onnx_of(network),
            look_aheads=np.array(network.shape.look_aheads),
            log_prior=np.zeros(180, np.float32),
            acoustic_scale=1.0,
            output_layer=layer,
        )
        scores = model.create_stream().score(frames)
        np.testing.assert_allclose(scores, rows[max(0, look_ahead - 2) :], atol=0.1)


# --- training


def test_the_loss_is_the_cross_entropy_of_soft_targets() -> None:
    posteriors = torch.tensor([[0.5, 0.25, 0.25], [0.125, 0.125, 0.75], [1 / 3, 1 / 3, 1 / 3]])
    states = torch.tensor([[0, 1], [2, 0], [1, 1]])
    probs = torch.tensor([[1.0, 0.0], [0.75, 0.25], [0.0, 0.0]])  # the last has no target
    expected = (np.log(2) + 0.75 * np.log(4 / 3) + 0.25 * np.log(8)) / 2
    found = cross_entropy(posteriors.log(), states, probs)
    assert float(found) == pytest.approx(expected, rel=1e-6)
    assert float(cross_entropy(posteriors.log(), states, 0 * probs)) == 0.0


# --- the recipe


def test_trains_and_writes_model_and_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("kouxing.training.neural.initial_network.Shape", SMALL)
    monkeypatch.setattr(blocks, "BATCH_S", 2)
    monkeypatch.setattr(blocks, "_LENGTHS", (20, 40))
    monkeypatch.setattr(teacher, "_NUM_STEPS", 2)
    corpus = write_corpus(tmp_path / "corpus", {"a": HELLO, "d": HELLO})
    whisper = write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6))
    (corpus / "broken.wav").write_bytes(b"no sound")
    output = tmp_path / "neural.npz"
    lines: list[str] = []
    train_neural(
        [corpus], output, aligner=model_path("gmm"), whisper=whisper,
        untranscribed=[corpus], num_steps=3, report=lines.append,
    )  # fmt: skip
    model = load_model(output)
    assert isinstance(model, NeuralModel)
    assert model.topology.num_states == 3 * 60
    assert model.look_aheads.tolist() == [1, 3, 6, 10, 20]
    assert model.look_ahead_frames == 1
    assert "1 of 1 recordings aligned" in lines
    assert "3 of 3 recordings labeled by the teacher" in lines
    assert any("errors on dev" in line for line in lines)
    assert lines[-1] == "1 row skipped"
    card = output.with_suffix(".md").read_text()
    assert "CC0-1.0" in card
    assert "aligned by `gmm.npz`, on 3 recordings" in card
