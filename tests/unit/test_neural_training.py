"""Other voices and the training of the network."""

from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from services.recognizer.load import load_model, model_path
from services.recognizer.neural import NeuralModel
from shared.audio_file import read_audio
from shared.errors import UserError
from shared.phones import UNITS
from training.corpus import RowErrors, read_corpus
from training.network import FRONT_FRAMES, NUM_INPUTS, Network, Shape
from training.network_export import networks_of, onnx_of
from training.network_training import FrontEnd, Recording, Trainer
from training.neural_recipe import train_neural
from training.second_language import as_nearest_units, load_second_language
from training.voice_change import Voice, VoiceChange, changed_voices

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
SHAPE = Shape(num_states=9, look_aheads=(0, 3), front=16, hidden=24)


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


# --- other voices


def in_voice(voice: Voice, warp: float) -> Voice:
    change = VoiceChange(
        median_f0_hz=120.0, intonation=1.0, warp_low=warp, warp_high=warp, breath=1.0, tilt=0.0
    )
    changed = voice.changed(change)
    assert changed.shape == HELLO.shape
    return Voice.analyse(changed)


def test_a_voice_is_moved_to_the_pitch_and_formants_asked_for() -> None:
    voice = Voice.analyse(HELLO)
    assert voice.median_f0_hz > 180
    low, high = in_voice(voice, 0.8), in_voice(voice, 1.25)
    assert [low.median_f0_hz, high.median_f0_hz] == pytest.approx([120, 120], rel=0.05)
    bins = np.arange(voice.envelope.shape[1])
    centres = []
    for one in (low, high):
        power = one.envelope[one.f0_hz > 0].mean(axis=0) ** 0.3
        centres.append((bins * power).sum() / power.sum())
    assert centres[1] > 1.1 * centres[0]


def test_silence_stays_silence() -> None:
    voice = Voice.analyse(np.zeros(8000, np.float32))
    change = VoiceChange.draw(np.random.default_rng(0), voice.median_f0_hz)
    assert np.abs(voice.changed(change)).max() < 1e-3


def test_copies_have_the_frames_of_the_recording(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", HELLO, 16_000)
    (tmp_path / "b.wav").write_bytes(b"no sound")
    rows = "".join(f"{n}\t{n}.wav\tS\tCC0\ttrain\t1.5\tni3\n" for n in "ab")
    header = "utt_id\tpath\tspeaker\tlicence\tsplit\tseconds\tpinyin\n"
    (tmp_path / "manifest.tsv").write_text(header + rows, encoding="utf-8")
    utterances = read_corpus(tmp_path, RowErrors())
    first, unreadable = changed_voices(utterances, num_voices=2, seed=0)
    assert [block.shape for block in first] == [(148, 41)] * 2
    assert not np.array_equal(first[0], first[1])
    assert [len(block) for block in unreadable] == [0, 0]
    other, _ = changed_voices(utterances, num_voices=2, seed=1)
    assert not np.array_equal(first[0], other[0])


# --- the network


@pytest.mark.parametrize("num_networks", [1, 2])
def test_the_file_computes_what_the_networks_do(num_networks: int) -> None:
    torch.manual_seed(0)
    networks = [Network(SHAPE).eval() for _ in range(num_networks)]
    frames = np.random.default_rng(0).normal(size=(20, NUM_INPUTS)).astype(np.float32)
    expected = []
    with torch.no_grad():
        hidden = [network(torch.from_numpy(frames)[None])[0] for network in networks]
        for head in range(len(SHAPE.look_aheads)):
            logits = [n.heads[head](h) for n, h in zip(networks, hidden, strict=True)]
            expected.append(torch.log_softmax(sum(logits) / num_networks, -1).numpy())
    shipped = load_model(model_path("neural"))
    assert isinstance(shipped, NeuralModel)
    model = NeuralModel(
        topology=shipped.topology,
        network=onnx_of(networks),
        look_aheads=np.array(SHAPE.look_aheads),
        log_prior=shipped.log_prior,
        prior_mean=shipped.prior_mean,
        spread=shipped.spread,
        kappa=1.0,
    )
    width = 24 * num_networks
    assert model.hidden_shape == (width, width)
    assert model.num_context == FRONT_FRAMES
    padded = np.concatenate([np.repeat(frames[:1], FRONT_FRAMES - 1, axis=0), frames])
    seen = np.stack([padded[at : at + FRONT_FRAMES].reshape(-1) for at in range(20)])
    for head, shares in enumerate(expected):
        found = model.session.run(
            None,
            {
                "x": np.stack([seen, seen], axis=1),
                "h1": np.zeros((1, 2, width), np.float32),
                "h2": np.zeros((1, 2, width), np.float32),
                "head": np.array(head),
            },
        )[0]
        np.testing.assert_allclose(found[:, 0], shares, atol=2e-3)


@pytest.mark.parametrize("num_networks", [1, 2])
def test_networks_come_back_from_their_file(num_networks: int) -> None:
    torch.manual_seed(0)
    networks = [Network(SHAPE) for _ in range(num_networks)]
    file = onnx_of(networks)
    again = networks_of(file, SHAPE.look_aheads)
    assert [network.shape for network in again] == [SHAPE] * num_networks
    np.testing.assert_array_equal(onnx_of(again), file)
    for wanted, found in zip(networks, again, strict=True):
        found_state = found.state_dict()
        for name, tensor in wanted.state_dict().items():
            if name.startswith("second_task") or (name.startswith("heads") and "bias" in name):
                continue  # the one is not in the file, of the other only the mean
            largest = float(tensor.abs().max())
            torch.testing.assert_close(found_state[name], tensor, atol=largest / 127, rtol=0)
    for head in range(len(SHAPE.look_aheads)):
        biases = [
            torch.stack([one.state_dict()[f"heads.{head}.bias"] for one in side]).mean(0)
            for side in (networks, again)
        ]
        torch.testing.assert_close(biases[0], biases[1])


def test_a_file_without_networks_is_refused() -> None:
    with pytest.raises(KeyError):
        networks_of(np.zeros(0, np.uint8), SHAPE.look_aheads)


def test_the_network_learns_made_up_sounds_beside_a_second_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("training.network_training._BATCH_FRAMES", 500)
    monkeypatch.setattr("training.network_training._AUGMENTED_SHARE", 0.2)
    monkeypatch.setattr("training.network_training._WARM_UP_STEPS", 1)
    monkeypatch.setattr("training.network_training._RATE", 1e-2)
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    patterns = rng.normal(14, 2, (SHAPE.num_states, NUM_INPUTS))

    def recording(first_target: int) -> Recording:
        states = np.repeat(rng.integers(0, SHAPE.num_states, 8), 8)
        log_mel = patterns[states] + rng.normal(0, 0.3, (len(states), NUM_INPUTS))
        targets = first_target + states
        return Recording(voices=(log_mel.astype(np.float16),), targets=targets, weight=1.0)

    recordings = [recording(first) for first in (0, 0, SHAPE.num_states) for _ in range(15)]
    trainer = Trainer(Network(SHAPE), FrontEnd.measure(recordings), recordings, main_head=1, seed=0)
    untrained = trainer.network.second_task.bias.detach().clone()
    losses: list[float] = []
    trainer.train(40, lambda _, loss: losses.append(loss))
    assert np.mean(losses[-3:]) < 0.6 * np.mean(losses[:3])
    assert not torch.equal(trainer.network.second_task.bias, untrained)
    assert trainer.mean is not trainer.network


# --- the recipe


@pytest.fixture
def corpora(tmp_path: Path) -> tuple[Path, Path]:
    """Two sentences in Mandarin, one for dev, and one said to be English."""
    corpus, second = tmp_path / "corpus", tmp_path / "second"
    corpus.mkdir()
    second.mkdir()
    soundfile.write(corpus / "a.wav", HELLO, 16_000)
    soundfile.write(second / "a.wav", HELLO, 16_000)
    pinyin = "ni3 hao3 huan1 ying2 lai2 dao4"
    header = "utt_id\tpath\tspeaker\tlicence\tsplit\tseconds\tpinyin\n"
    rows = [f"{n}\ta.wav\tS\tCC0-1.0\t{'dev' if n else 'train'}\t1.5\t{pinyin}\n" for n in range(2)]
    (corpus / "manifest.tsv").write_text(header + "".join(rows), encoding="utf-8")
    (second / "manifest.tsv").write_text(
        "utt_id\tpath\tseconds\tarpabet\nx\ta.wav\t1.5\tHH AH L OW\n", encoding="utf-8"
    )
    return corpus, second


def test_the_recipe_writes_model_card_and_curves(
    corpora: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corpus, second = corpora
    monkeypatch.setattr("training.network_training._BATCH_FRAMES", 300)
    lines: list[str] = []
    output = tmp_path / "neural.npz"
    train_neural(
        [corpus], output, aligner=model_path("gmm"), second_task=second,
        look_ahead_ms=150.0, num_steps=10, num_networks=1, num_voices=1, report=lines.append,
    )  # fmt: skip
    model = load_model(output)
    assert isinstance(model, NeuralModel)
    assert model.topology.num_states == 3 * 60
    assert model.look_ahead_frames == 15
    assert load_model(output, look_ahead_ms=60.0).topology.num_states == 3 * 60
    assert "aligned anew" in "".join(lines)
    assert "CC0-1.0" in output.with_suffix(".md").read_text()
    assert output.with_suffix(".png").stat().st_size > 1000
    # and learns further, with nothing to judge it by
    further = tmp_path / "further.npz"
    manifest = corpus / "manifest.tsv"
    manifest.write_text(manifest.read_text().replace("\tdev\t", "\ttest\t"))
    train_neural(
        [corpus], further, aligner=model_path("gmm"), start=output, language=model_path("gmm"),
        look_ahead_ms=150.0, num_steps=1, num_networks=1, num_voices=0, report=lines.append,
    )  # fmt: skip
    learnt = load_model(further)
    assert isinstance(learnt, NeuralModel)
    np.testing.assert_array_equal(learnt.prior_mean, model.prior_mean)
    np.testing.assert_array_equal(learnt.spread, model.spread)
    (before,), (after,) = (networks_of(m.network, m.look_aheads.tolist()) for m in (model, learnt))
    for name, weights in before.state_dict().items():
        if not name.startswith("second_task"):
            torch.testing.assert_close(after.state_dict()[name], weights, atol=0.01, rtol=0.05)
    shipped = load_model(model_path("gmm")).topology.language
    np.testing.assert_array_equal(learnt.topology.language.unit, shipped.unit)


@pytest.mark.parametrize("start", ["gmm", "neural"])
def test_what_cannot_learn_further_is_refused(
    start: str, corpora: tuple[Path, Path], tmp_path: Path
) -> None:
    """A Gaussian mixture model, and networks without an output layer for 150 ms."""
    with pytest.raises(UserError, match="not written by this command with a look-ahead of 150 ms"):
        train_neural(
            [corpora[0]], tmp_path / "n.npz", aligner=model_path("gmm"), start=model_path(start),
            look_ahead_ms=150.0, num_steps=1, num_networks=1, num_voices=0,
        )  # fmt: skip


def test_networks_that_learn_side_by_side_become_one_model(
    corpora: tuple[Path, Path], tmp_path: Path
) -> None:
    output = tmp_path / "neural.npz"
    train_neural(
        [corpora[0]], output, aligner=model_path("gmm"),
        num_steps=1, num_networks=2, num_voices=0, report=lambda _: None,
    )  # fmt: skip
    model = load_model(output)
    assert isinstance(model, NeuralModel)
    assert model.hidden_shape == (512, 512)


@pytest.mark.parametrize(
    ("manifest", "message"),
    [
        ("utt_id\tpath\nx\ta.wav\n", "is no list of utt_id"),
        ("utt_id\tpath\tseconds\tarpabet\nx\ta.wav\t1.5\tHH QQ\n", "QQ"),
        ("utt_id\tpath\tseconds\tarpabet\nx\ta.wav\t1.5\t" + 90 * "HH " + "\n", "long enough"),
    ],
)
def test_mistakes_in_the_second_language_are_named(
    corpora: tuple[Path, Path], manifest: str, message: str
) -> None:
    second = corpora[1]
    (second / "manifest.tsv").write_text(manifest, encoding="utf-8")
    with pytest.raises(UserError, match=message):
        load_second_language(second, RowErrors())


def test_phones_are_taken_for_the_units_that_sound_like_them(corpora: tuple[Path, Path]) -> None:
    (example,) = load_second_language(corpora[1], RowErrors())
    (heard,) = as_nearest_units([example])
    assert [UNITS[unit] for unit in heard.units] == ["h", "e", "l", "ou"]
    assert len(example.units) == len(example.syllables) == 4
