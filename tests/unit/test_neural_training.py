"""Whisper's weights, augmentation, and the training of the network."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from kouxing.corpora.feature_cache import as_floats
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import PHONE_LM_PATH, shipped_phone_lm
from kouxing.services.recognizer.acoustic.network import WINDOW
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import LogMel
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS, WhisperMel
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.training.neural import augmentation, batches, teacher, trainer
from kouxing.training.neural.alignment import log_posteriors_of
from kouxing.training.neural.augmentation import (
    augment_samples,
    scale_level,
)
from kouxing.training.neural.batches import Recording, Targets, augment
from kouxing.training.neural.export import network_of, onnx_of
from kouxing.training.neural.initial_network import load_whisper
from kouxing.training.neural.network import Network, Shape
from kouxing.training.neural.optimizer import cross_entropy
from kouxing.training.neural.recipe import train_neural
from kouxing.training.neural.trainer import Trainer
from kouxing.training.training_set import load_examples, load_untranscribed
from tests.languages import MANDARIN
from tests.tones import burst, tones
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = [pytest.mark.unit, pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

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


def test_loads_integers_and_bfloat16(tmp_path: Path) -> None:
    arrays = encoder_arrays()
    name = "encoder/layer_0/ffn/linear_0/weight"
    weight = arrays[name].astype(np.float32)
    scale = 127 / np.abs(weight).max(axis=1)
    arrays[name] = np.rint(weight * scale[:, None]).astype(np.int8)
    arrays[f"{name}_scale"] = scale.astype(np.float32)
    bias = "encoder/conv1/bias"
    short = (arrays[bias].astype(np.float32).view(np.uint32) >> 16).astype(np.uint16)
    expected = arrays[bias].astype(np.float32)
    arrays[bias] = short
    network = Network(SHAPE)
    load_whisper(network, write_whisper(tmp_path, arrays))
    read = network.state_dict()
    found = floats(read["layers.0.inner.weight"])
    np.testing.assert_allclose(found, weight, atol=float(np.abs(weight).max()) / 250)
    np.testing.assert_allclose(floats(read["first.bias"]), expected, rtol=2**-7)


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
    for scale, message in (
        (np.zeros(32), "values that are not finite"),
        (np.ones(5), "_scale has 5 values"),
    ):
        scaled = encoder_arrays() | {"encoder/conv1/weight_scale": scale.astype(np.float32)}
        write_whisper(tmp_path, scaled)
        refused(message)
    flat = encoder_arrays() | {"encoder/conv1/weight": np.ones((), np.float32)}
    write_whisper(tmp_path, flat | {"encoder/conv1/weight_scale": np.ones(1, np.float32)})
    refused("not a Whisper model")
    (tmp_path / "model.bin").write_bytes(b"")
    refused("not a Whisper model")


def test_checks_every_size_in_the_file(tmp_path: Path) -> None:
    """A file cut anywhere, and one with any number in it made enormous, is refused."""
    write_whisper(tmp_path, encoder_arrays(num_layers=2))
    path = tmp_path / "model.bin"
    content = path.read_bytes()
    used = len(content) - 4  # the aliases at the end are not read
    for size in [*range(1, 90), *range(90, used, 997), used - 1]:
        path.write_bytes(content[:size])
        with pytest.raises(UserError, match="not a Whisper model"):
            load_whisper(Network(SHAPE), tmp_path)
    first_array = content.index(b"encoder/conv1/weight\0") + len("encoder/conv1/weight") + 1
    for at in range(first_array, first_array + 18):  # rank, sizes, kind, number of bytes
        path.write_bytes(content[:at] + b"\xff" + content[at + 1 :])
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
    monkeypatch.setattr(augmentation, "_MAX_MASKS", 0)
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


# --- samples beside frames


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


def test_examples_contain_the_samples_of_their_frames(tmp_path: Path) -> None:
    late = np.concatenate([np.zeros(20_000, np.float32), HELLO, np.zeros(20_000, np.float32)])
    corpus = write_corpus(tmp_path / "corpus", {"a": late, "b": HELLO})
    plain = load_examples([corpus], RowErrors(), MANDARIN)
    examples = load_examples([corpus], RowErrors(), MANDARIN, with_samples=True)
    assert [example.samples for example in plain] == [None, None]
    for example, one in zip(examples, plain, strict=True):
        assert example.samples is not None
        assert example.samples.dtype == np.int16
        assert isinstance(example.samples, np.memmap)
        np.testing.assert_array_equal(example.log_mel, one.log_mel)
        again = LogMel().accept_waveform(as_floats(example.samples))
        np.testing.assert_array_equal(again.astype(np.float16), example.log_mel)
    assert len(examples[0].log_mel) < len(late) / 160 - 150


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


@torch.no_grad()
def test_a_position_attends_only_to_its_window() -> None:
    torch.manual_seed(0)
    network = Network(SMALL(num_states=6, look_aheads=(1,), layers=1)).eval()
    frames = random_frames(2 * WINDOW + 21)
    hidden = network(frames)
    changed = frames.clone()
    changed[:, :5] += 3.0  # positions 0 to 3 have seen it
    difference = (network(changed) - hidden).abs().amax(dim=(0, 2))
    assert (difference[: WINDOW + 3] > 1e-6).all()
    assert (difference[WINDOW + 3 :] < 1e-6).all()


@pytest.mark.parametrize("num_samples", [8000, 8160, 560])
def test_scores_whole_recordings_like_the_recognizer(num_samples: int) -> None:
    torch.manual_seed(0)
    network = Network(SHAPE).eval()
    samples = np.rint(32767 * HELLO[4000 : 4000 + num_samples]).astype(np.int16)
    model = NeuralModel(
        topology=load_model(model_path("gmm")).topology,
        network=onnx_of(network, exact=True),
        look_aheads=np.array(SHAPE.look_aheads),
        log_prior=np.zeros(6, np.float32),
        acoustic_scale=1.0,
    )
    for output, look_ahead in enumerate(SHAPE.look_aheads):
        stream = model.with_look_ahead(10.0 * look_ahead).create_stream()
        frames = WhisperMel().accept_waveform(as_floats(samples))
        expected = np.concatenate([stream.score(frames), stream.score(None)])
        found = log_posteriors_of(network, output, samples)
        assert found.shape == (len(frames), 6)
        np.testing.assert_allclose(found, expected, atol=1e-4)


# --- training


def test_the_loss_is_the_cross_entropy_of_soft_targets() -> None:
    posteriors = torch.tensor([[0.5, 0.25, 0.25], [0.125, 0.125, 0.75], [1 / 3, 1 / 3, 1 / 3]])
    states = torch.tensor([[0, 1], [2, 0], [1, 1]])
    probs = torch.tensor([[1.0, 0.0], [0.75, 0.25], [0.0, 0.0]])  # the last has no target
    expected = (np.log(2) + 0.75 * np.log(4 / 3) + 0.25 * np.log(8)) / 2
    found = cross_entropy(posteriors.log(), states, probs)
    assert float(found) == pytest.approx(expected, rel=1e-6)
    assert float(cross_entropy(posteriors.log(), states, 0 * probs)) == 0.0


def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "_BATCH_FRAMES", 300)
    monkeypatch.setattr(batches, "_POOL_BATCHES", 2)
    monkeypatch.setattr(trainer, "_WARM_UP_STEPS", 2)
    monkeypatch.setattr(teacher, "_BATCH_POSITIONS", 200)
    monkeypatch.setattr(teacher, "_NUM_STEPS", 5)


def trained(
    recordings: list[Recording], num_steps: int, seed: int = 0, main_output: int = 1
) -> tuple[Trainer, list[float]]:
    torch.manual_seed(seed)
    network = Network(SHAPE)
    with torch.no_grad():  # trained convolutions differ more than new ones
        network.first.weight *= 6
        network.second.weight *= 6
    learner = Trainer(network, recordings, main_output=main_output, seed=seed)
    return learner, [loss for _, loss in learner.train(num_steps)]


@pytest.mark.parametrize("main_output", [0, 1])
def test_the_network_learns_tones(main_output: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loss falls, and an output layer tells the states of its frames."""
    quick(monkeypatch)
    monkeypatch.setattr(augmentation, "_MAX_MASKS", 0)
    monkeypatch.setattr(trainer, "_RATE", 5e-3)
    monkeypatch.setattr(trainer, "_NEW_RATE", 5e-3)
    monkeypatch.setattr(batches, "_AUGMENT_PROB", 0.0)
    recordings = [tones(seed) for seed in range(8)]
    learner, losses = trained(recordings, 100, main_output=main_output)
    assert np.mean(losses[-10:]) < 0.2 * np.mean(losses[:10])
    unseen = tones(100)
    found = log_posteriors_of(learner.mean, main_output, unseen.samples).argmax(axis=1)
    assert np.mean(found == unseen.targets.states[:, 0]) > 0.94  # two frames late would be 0.9


# --- the recipe


@pytest.fixture
def corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two recordings of a sentence, one of them for dev; networks and batches are small."""
    quick(monkeypatch)
    monkeypatch.setattr("kouxing.training.neural.initial_network.Shape", SMALL)
    return write_corpus(tmp_path / "corpus", {"a": HELLO, "d": HELLO})


@pytest.fixture
def whisper(tmp_path: Path) -> Path:
    return write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6))


def test_trains_and_writes_model_card_and_curves(
    corpus: Path, whisper: Path, tmp_path: Path
) -> None:
    lines: list[str] = []
    output = tmp_path / "neural.npz"
    train_neural(
        [corpus], output, aligner=model_path("gmm"), whisper=whisper,
        look_ahead_ms=150.0, num_steps=10, num_threads=1, report=lines.append,
    )  # fmt: skip
    model = load_model(output)
    assert isinstance(model, NeuralModel)
    assert model.topology.num_states == 3 * 60
    assert model.look_aheads.tolist() == [1, 3, 6, 10, 15, 20]
    assert model.look_ahead_frames == 15
    assert load_model(output, look_ahead_ms=60.0).topology.num_states == 3 * 60
    learnt = network_of(model.network, model.look_aheads.tolist()).state_dict()
    conv1 = encoder_arrays(6)["encoder/conv1/weight"].astype(np.float32)
    np.testing.assert_allclose(learnt["first.weight"], conv1, atol=np.abs(conv1).max() / 120)
    assert sum("dev phone error" in line for line in lines) >= 10
    assert "step 5: realigned" in lines
    assert lines.count("1 of 1 recordings aligned") == 2
    assert "1 of 1 recordings encoded for the teacher" in lines
    assert "1 of 1 recordings labeled by the teacher" in lines
    assert sum("teacher, step" in line for line in lines) == 5
    card = output.with_suffix(".md").read_text()
    assert "CC0-1.0" in card
    assert "Whisper's weights (Radford et al. 2023, MIT license)" in card
    assert "with a readout of Whisper's whole encoder as the teacher." in card
    assert output.with_suffix(".png").stat().st_size > 1000


def test_the_teacher_labels_recordings_without_text(
    corpus: Path, whisper: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of a sentence's targets are the teacher's, before and after it is realigned."""
    folder = tmp_path / "other" / "deep"
    folder.mkdir(parents=True)
    soundfile.write(folder / "x.wav", HELLO[:16_000], 16_000)
    (folder / "y.wav").write_bytes(b"no sound")
    learnt: list[list[Recording]] = []
    replace_recordings = Trainer.replace_recordings

    def noted(learner: Trainer, recordings: Sequence[Recording]) -> None:
        learnt.append(list(recordings))
        replace_recordings(learner, recordings)

    monkeypatch.setattr(Trainer, "replace_recordings", noted)
    lines: list[str] = []
    output = tmp_path / "neural.npz"
    train = partial(train_neural, [corpus], aligner=model_path("gmm"), num_threads=1)
    train(
        output, whisper=whisper, untranscribed=[tmp_path / "other"], num_steps=2,
        report=lines.append,
    )  # fmt: skip
    assert len(learnt) == 2
    for sentence, other in learnt:
        assert sentence.targets.states.shape[1] == 9
        assert (sentence.targets.probs[:, 0] == 0.5).all()
        assert other.targets.states.shape[1] == 8
        for one, mix in ((sentence, 0.33), (other, 0.29)):
            sums = one.targets.probs.sum(axis=1, dtype=np.float32)
            np.testing.assert_allclose(sums, 1.0, atol=2e-3)
            assert one.weight * len(one.targets) == pytest.approx(mix)
    for first, again in zip(*learnt, strict=True):
        np.testing.assert_array_equal(first.targets.states[:, 1:], again.targets.states[:, 1:])
    assert "2 of 2 recordings labeled by the teacher" in lines
    assert "1 rows skipped" in lines
    assert "also on 0.0 minutes without text" in output.with_suffix(".md").read_text()
    train(tmp_path / "further.npz", whisper=whisper, start=output, num_steps=1, report=lines.append)
    card = (tmp_path / "further.md").read_text()
    assert "started with `neural.npz`" in card
    assert "as the teacher" in card


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


def test_training_is_reproducible_and_can_continue(
    corpus: Path, whisper: Path, tmp_path: Path
) -> None:
    manifest = corpus / "manifest.tsv"  # nothing to test on
    manifest.write_text(manifest.read_text().replace("\tdev\t", "\ttest\t"))
    first, second, further = (tmp_path / f"{name}.npz" for name in ("first", "second", "further"))
    lines: list[str] = []
    train = partial(train_neural, [corpus], num_threads=1, report=lines.append)
    for path in (first, second):
        train(path, aligner=model_path("gmm"), whisper=whisper, num_steps=3)
    assert first.read_bytes() == second.read_bytes()
    assert torch.get_num_threads() == 1
    train(further, start=first, phone_lm=PHONE_LM_PATH, num_steps=2)
    assert [line for line in lines if "realigned" in line] == ["step 2: realigned"] * 2
    before, after = load_model(first), load_model(further)
    assert isinstance(before, NeuralModel)
    assert isinstance(after, NeuralModel)
    old, new = (
        network_of(model.network, model.look_aheads.tolist()).state_dict()
        for model in (before, after)
    )
    for name, weights in old.items():
        torch.testing.assert_close(new[name], weights, atol=0.02, rtol=0.05)
    card = further.with_suffix(".md").read_text()
    assert "started with `first.npz`" in card
    assert "aligned by the same model" in card
    np.testing.assert_array_equal(after.topology.phone_lm.phone, shipped_phone_lm().phone)
    assert len(before.topology.phone_lm.phone) < len(shipped_phone_lm().phone)


def test_training_needs_a_start(corpus: Path, tmp_path: Path) -> None:
    train = partial(train_neural, [corpus], tmp_path / "n.npz", aligner=model_path("gmm"))
    with pytest.raises(UserError, match="give --whisper, --start-from or both"):
        train(num_threads=1)
    with pytest.raises(UserError, match="need a teacher; also give --whisper"):
        train(num_threads=1, start=model_path("gmm"), untranscribed=[corpus])
    with pytest.raises(UserError, match="give --aligner or --start-from"):
        train(aligner=None, num_threads=1, whisper=tmp_path)
    with pytest.raises(UserError, match=r"cannot read .*model\.bin"):
        train(num_threads=1, whisper=tmp_path)
    with pytest.raises(UserError, match=r"not trained here .* 10, 30, 60, 100, 200 ms"):
        train(num_threads=1, start=model_path("gmm"))


@pytest.mark.parametrize("look_ahead_ms", [0.0, 5.0, 25.0, -10.0, 2000.0, float("nan")])
def test_rejects_invalid_look_aheads(look_ahead_ms: float, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be trained; give 10, 20, 30"):
        train_neural(
            [], tmp_path / "n.npz", aligner=model_path("gmm"), whisper=tmp_path,
            look_ahead_ms=look_ahead_ms, num_threads=1,
        )  # fmt: skip
