"""Whisper's weights, augmentation, and the training of the network."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from kouxing.corpora.feature_cache import as_floats
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.network import WINDOW
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.training.blocks import batches as blocks
from kouxing.training.neural import augmentation, recipe, teacher
from kouxing.training.neural.augmentation import augment_samples, scale_level
from kouxing.training.neural.batches import Recording, Targets, augment
from kouxing.training.neural.export import onnx_of
from kouxing.training.neural.initial_network import load_whisper
from kouxing.training.neural.network import Network, Shape
from kouxing.training.neural.optimizer import cross_entropy
from kouxing.training.neural.recipe import train_network, train_neural
from kouxing.training.training_set import load_untranscribed
from tests.tones import burst, tones
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
    write_whisper(tmp_path, encoder_arrays(), name="TransformerSpec")
    refused("contains a 'TransformerSpec'")
    write_whisper(tmp_path, encoder_arrays(), version=3)
    refused("its version 3 is too old")
    unclear = encoder_arrays()
    unclear["encoder/conv2/bias"][3] = np.nan
    write_whisper(tmp_path, unclear)
    refused("conv2/bias contains values that are not finite")
    name = "encoder/conv1/weight"
    quantized = encoder_arrays() | {name: np.ones((32, NUM_MELS, 3), np.int8)}
    write_whisper(tmp_path, quantized)
    refused("conv1/weight is quantized")
    (tmp_path / "model.bin").write_bytes(b"")
    refused("not a Whisper model")


def test_rejects_a_file_that_is_cut(tmp_path: Path) -> None:
    write_whisper(tmp_path, encoder_arrays(num_layers=2))
    path = tmp_path / "model.bin"
    content = path.read_bytes()
    for size in (*range(1, 90, 7), len(content) // 2, len(content) - 5):
        path.write_bytes(content[:size])
        with pytest.raises(UserError, match="not a Whisper model"):
            load_whisper(Network(SHAPE), tmp_path)


# --- augmentation


def test_augmentation_is_reproducible() -> None:
    results = []
    for seed in (*range(40), *range(40)):
        rng = np.random.default_rng(seed)
        sound, speed = augment_samples(HELLO, rng)
        results.append(scale_level(sound, rng))
        assert len(sound) == pytest.approx(len(HELLO) / speed, abs=1)
        assert np.isfinite(results[-1]).all()
        assert 10 ** (-36.1 / 20) < np.abs(results[-1]).max() <= 1.001
    for first, second in zip(results[:40], results[40:], strict=True):
        np.testing.assert_array_equal(first, second)
    assert len({len(sound) for sound in results}) == 8  # speeds
    silence = np.zeros(4000, np.float32)
    for seed in range(40):
        assert np.abs(augment_samples(silence, np.random.default_rng(seed))[0]).max() < 1e-3


def test_targets_stay_aligned_under_augmentation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a tone begins and ends, its targets do, whatever the speed and the tempo."""
    for share in ("_ROOM_PROB", "_NOISE_PROB"):
        monkeypatch.setattr(augmentation, share, 0.0)
    sound = burst(1.0, 1.8, 3.0)
    middle_s = (np.arange(298) * 160 + 200) / 16_000
    inside = (middle_s >= 1.0) & (middle_s < 1.8)
    tone = Targets(
        np.outer(inside, [3, 5]).astype(np.uint16), np.full((298, 2), [0.75, 0.25], np.float16)
    )
    targets = Targets.hard(inside.astype(np.int64)).averaged_with(tone)
    samples = np.rint(32767 * sound).astype(np.int16)
    recording = Recording(samples=samples, targets=targets, weight=1.0)
    lengths = []
    for seed in range(60):
        frames, changed = augment(recording, np.random.default_rng(seed))
        assert frames.shape == (len(changed), NUM_MELS)
        loud = frames.max(axis=1) > frames.max() - 0.5
        at, target = np.flatnonzero(loud), np.flatnonzero(changed.states[:, 0])
        np.testing.assert_array_equal(changed.states, changed.states[:, :1] * np.array([1, 3, 5]))
        np.testing.assert_array_equal(changed.probs[7], [0.5, 0.375, 0.125])
        assert abs(at[0] - target[0]) <= 2
        assert abs(at[-1] - target[-1]) <= 2
        lengths.append(len(frames))
    assert min(lengths) < 250
    assert max(lengths) > 350


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


def random_frames(num_frames: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(
        np.random.default_rng(seed).normal(0, 0.5, (1, num_frames, NUM_MELS)).astype(np.float32)
    )


@torch.no_grad()
def test_the_network_is_causal() -> None:
    torch.manual_seed(0)
    network = Network(SHAPE).eval()
    frames = random_frames(41)
    hidden = network(frames)
    assert hidden.shape == (1, 20, 32)
    for position in (0, 7, 18):
        last_seen = 2 * position + 2
        changed = frames.clone()
        changed[:, last_seen + 1 :] = 3.0
        torch.testing.assert_close(network(changed)[:, : position + 1], hidden[:, : position + 1])
        changed = frames.clone()
        changed[:, last_seen] += 3.0
        assert (network(changed)[0, position] - hidden[0, position]).abs().max() > 1e-3


def test_onnxruntime_computes_what_pytorch_does() -> None:
    torch.manual_seed(0)
    network = Network(SMALL(num_states=180, look_aheads=(2, 7))).eval()
    frames = random_frames(2 * WINDOW + 21)
    for layer, look_ahead in enumerate(network.shape.look_aheads):
        with torch.no_grad():
            rows = network.log_posteriors(network(frames), layer)[0].flatten(0, 1).numpy()
        model = NeuralModel(
            topology=load_model().topology,
            network=onnx_of(network),
            look_aheads=np.array(network.shape.look_aheads),
            log_prior=np.zeros(180, np.float32),
            acoustic_scale=1.0,
            output_layer=layer,
        )
        scores = model.create_stream().score(frames[0].numpy())
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


def test_the_network_learns_tones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first output layer recognizes the tones of an unseen recording."""
    monkeypatch.setattr(recipe, "_RATE", 5e-3)
    monkeypatch.setattr(recipe, "_NEW_RATE", 5e-3)
    monkeypatch.setattr(recipe, "_WARM_UP_STEPS", 2)
    monkeypatch.setattr(blocks, "BATCH_S", 3)
    monkeypatch.setattr(blocks, "_LENGTHS", (40,))
    for prob in ("_DISTURB_PROB", "_TEMPO_PROB", "_HURRY_PROB"):
        monkeypatch.setattr(blocks, prob, 0.0)
    torch.manual_seed(0)
    network = Network(SHAPE)
    with torch.no_grad():  # trained convolutions differ more than new ones
        network.first.weight *= 6
        network.second.weight *= 6
    recordings = [tones(seed) for seed in range(8)]
    trained = train_network(network, recordings, seed=0, num_steps=100, report=lambda _: None)
    unseen = tones(100)
    frames = torch.from_numpy(WhisperMel().accept_waveform(as_floats(unseen.samples)))[None]
    with torch.no_grad():
        states = trained.log_posteriors(trained(frames), 0)[0].flatten(0, 1).argmax(dim=1).numpy()
    truth = unseen.targets.states[1 : 1 + len(states), 0]  # a look-ahead of one frame
    assert np.mean(states[: len(truth)] == truth) > 0.9


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
    assert lines[-1] == "1 rows skipped"
    card = output.with_suffix(".md").read_text()
    assert "CC0-1.0" in card
    assert "aligned by `gmm.npz`, on 3 recordings" in card


def test_trims_and_cuts_recordings_without_text(tmp_path: Path) -> None:
    silence = np.zeros(20_000, np.float32)
    long = np.concatenate([silence, *[HELLO] * 20, silence])
    soundfile.write(tmp_path / "a.flac", long, 16_000)
    soundfile.write(tmp_path / "b.wav", HELLO[:2000], 16_000)
    (tmp_path / "c.ogg").write_bytes(b"no sound")
    (tmp_path / "d.txt").write_text("no sound")
    (tmp_path / "MOSS-TTSD_kept_back.ogg").write_bytes(b"not read")
    errors = RowErrors()
    first, second = load_untranscribed([tmp_path], errors)
    assert len(first) == 2000 * 160 + 240
    assert 8 * 16_000 < len(second) < 11 * 16_000
    np.testing.assert_array_equal(first[2000 * 160 :], second[:240])
    assert [message.split(": ", 1)[1] for message in errors.messages] == [
        f"no audio in {tmp_path / 'c.ogg'}; row skipped",
        "it is too short; row skipped",
    ]
