"""Training of the block model: its network in PyTorch, its batches, tuning, the recipe."""

from pathlib import Path

import numpy as np
import pytest
import torch

from kouxing.corpora.feature_cache import as_floats
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.front_end.whisper_mel import FLOOR_BANDS, WhisperMel
from kouxing.shared.errors import UserError
from kouxing.training.blocks import batches, readout, trainer
from kouxing.training.blocks.batches import block_batch
from kouxing.training.blocks.network import RIGHT_CONTEXT, BlockEncoder, BlockReadout, layout
from kouxing.training.blocks.readout import encode_windows, train_readout
from kouxing.training.blocks.recipe import train_blocks
from kouxing.training.blocks.trainer import BlockNetwork, train_network
from kouxing.training.neural import optimizer, teacher
from kouxing.training.neural.batches import Recording, Targets
from kouxing.training.neural.network import Readout, ReadoutShape
from kouxing.training.neural.teacher import WholeEncoder
from tests.tones import tones
from tests.unit.test_block_model import HELLO, SMALL
from tests.unit.test_neural_training import write_corpus
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = pytest.mark.usefixtures("one_thread")

RECORDINGS = [tones(seed) for seed in range(12)]
SMALL_READOUT = ReadoutShape(inner=48, gru=24, dropout=0.2, noise=0.15)


def small_network() -> BlockNetwork:
    torch.manual_seed(0)
    return BlockNetwork(
        BlockEncoder(SMALL(num_states=6)), BlockReadout(96, 6, SMALL_READOUT)
    ).eval()


@torch.no_grad()
def outputs(network: BlockNetwork, frames: np.ndarray, block_length: int) -> torch.Tensor:
    """Compute log posteriors by block, (blocks, B + R, 2, states)."""
    laid = layout((len(frames) - 1) // 2, block_length)
    features = network.encoder(torch.from_numpy(frames)[None], laid)
    return network.readout.read(features, laid)[0, laid.blocks]


def whole_encoder() -> WholeEncoder:
    torch.manual_seed(0)
    encoder = WholeEncoder(SMALL(num_states=6)).eval()
    with torch.no_grad():  # trained convolutions differ more than new ones
        encoder.first.weight *= 6
        encoder.second.weight *= 6
    return encoder


@pytest.mark.parametrize("block_length", [4, 10])
def test_a_block_needs_only_its_right_context(block_length: int) -> None:
    network = small_network()
    frames = np.random.default_rng(0).normal(0.5, 0.5, (121, 80)).astype(np.float32)
    whole = outputs(network, frames, block_length)
    for block in (0, 2):
        needed = 2 * (block_length * (block + 1) + RIGHT_CONTEXT) + 1
        live = outputs(network, frames[:needed], block_length)
        torch.testing.assert_close(live[block], whole[block], rtol=0, atol=1e-5)
        changed = frames.copy()
        changed[needed - 1] = 0.0
        assert (outputs(network, changed, block_length)[block] - whole[block]).abs().max() > 1e-4


def test_the_teacher_gets_the_clean_audio(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "_DISTURB_PROB", 0.0)
    batch = block_batch(RECORDINGS, 0, 1)
    again = block_batch(RECORDINGS, 0, 1)
    torch.testing.assert_close(batch.frames, again.frames, rtol=0, atol=0)
    num_frames = batch.frames.shape[1]
    assert batch.states.shape[1:3] == ((num_frames - 1) // 2, 2)
    clean = batch.clean[:, :, :num_frames].transpose(1, 2)
    apart = batch.frames - clean  # of levels, where no floor is reached
    loud = (clean > clean.amax(dim=(1, 2), keepdim=True) - FLOOR_BANDS / 2) & (batch.frames > 0.3)
    for excerpt, where in zip(apart, loud, strict=True):
        assert excerpt[where].std() < 0.02
    monkeypatch.setattr(batches, "_DISTURB_PROB", 1.0)
    disturbed = block_batch(RECORDINGS, 0, 1)
    assert (disturbed.frames[0] - batch.frames[0]).abs().mean() > 0.05


@pytest.mark.parametrize("number", range(2))
def test_codecs_and_clipping_do_not_shift_the_audio(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "_CODEC_PROB", 1.0)
    monkeypatch.setattr(batches, "_CLIP_PROB", 0.0 if number % 2 else 1.0)
    sound = HELLO
    coded = batches._distort(sound, np.random.default_rng(number))
    assert np.abs(coded).max() > 0.3
    shifts = range(-200, 201, 20)
    likeness = [np.dot(sound[4000:20_000], np.roll(coded, -shift)[4000:20_000]) for shift in shifts]
    assert shifts[int(np.argmax(likeness))] == 0


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_S", 2)
    monkeypatch.setattr(batches, "_LENGTHS", (30, 40))
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 2)
    monkeypatch.setattr(readout, "READOUT", SMALL_READOUT)
    monkeypatch.setattr(readout, "BATCH_S", 3)
    monkeypatch.setattr(readout, "MAX_WINDOW_FRAMES", 80)
    monkeypatch.setattr(readout, "_FIXED_FRAMES", 50)


@pytest.mark.usefixtures("quick")
def test_the_readout_learns_tones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def as_it_is(recording: Recording, _rng: np.random.Generator) -> tuple[np.ndarray, Targets]:
        return WhisperMel().accept_waveform(as_floats(recording.samples)), recording.targets

    monkeypatch.setattr(readout, "augment", as_it_is)
    encoder = whole_encoder()
    recordings = [tones(seed) for seed in range(12)]
    lines: list[str] = []

    def train(num_steps: int, name: str) -> Readout:
        return train_readout(
            encoder, recordings, 6,
            seed=0, num_steps=num_steps, checkpoint=tmp_path / name, report=lines.append,
        )  # fmt: skip

    whole = train(120, "whole")
    unseen = tones(100)
    frames = WhisperMel().accept_waveform(as_floats(unseen.samples))
    with torch.no_grad():
        found = whole(encode_windows(encoder, frames[None]))[0, : len(frames)]
    assert np.mean(found.argmax(dim=-1).numpy() == unseen.targets.states[:, 0]) > 0.93
    assert lines[-1].startswith("step 120: ")


@pytest.mark.usefixtures("quick")
def test_the_encoder_learns_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "_WARM_UP_STEPS", 5)
    monkeypatch.setattr(trainer, "_RATE", 2e-3)
    lines: list[str] = []

    def train(num_steps: int, name: str, stop_at: str = "never") -> BlockNetwork:
        def report(line: str) -> None:
            lines.append(line)
            if line.startswith(f"{stop_at}:"):
                raise KeyboardInterrupt

        network = small_network()
        whole = WholeEncoder(SMALL(num_states=6)).eval()
        whole.load_state_dict(network.encoder.state_dict())
        return train_network(
            network, whole, RECORDINGS,
            seed=0, num_steps=num_steps, checkpoint=tmp_path / name, report=report,
        )  # fmt: skip

    train(20, "whole")
    first, last = (float(lines[place].split()[3]) for place in (0, -1))
    assert last < first - 0.1
    begun = small_network().state_dict()
    done = train(4, "first").state_dict()
    assert torch.equal(done["encoder.second.weight"], begun["encoder.second.weight"]), "frozen"
    with pytest.raises(KeyboardInterrupt):
        train(4, "second", stop_at="step 4")
    again = train(4, "second").state_dict()
    assert "resuming after step 2" in lines
    for name, weights in done.items():
        torch.testing.assert_close(again[name], weights, rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_trains_and_writes_model_and_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("kouxing.training.neural.initial_network.Shape", SMALL)
    monkeypatch.setattr(teacher, "_NUM_STEPS", 2)
    corpus = write_corpus(tmp_path / "corpus", {"a": HELLO, "b": HELLO, "d": HELLO})
    whisper = write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6))
    output = tmp_path / "blocks.npz"
    lines: list[str] = []
    train_blocks(
        [corpus], output, whisper=whisper, untranscribed=[corpus],
        seed=1, num_readout_steps=4, num_steps=2, report=lines.append,
    )  # fmt: skip
    assert "5 of 5 recordings labeled by the teacher" in lines
    model = load_model(output)
    assert isinstance(model, BlockModel)
    stream = model.create_stream()
    frames = WhisperMel().accept_waveform(HELLO)
    assert len(stream.score(frames)) + len(stream.score(None)) == len(frames)
    np.testing.assert_array_equal(model.topology.log_stay, load_model().topology.log_stay)
    card = output.with_suffix(".md").read_text()
    assert "4 steps of the readout, 2 of" in card
    assert "on 5 recordings of 0 minutes drawn from those below" in card
    assert "CC0-1.0" in card
    left = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert left == {"blocks.npz", "blocks.md"}


def test_needs_a_neural_model_to_start_from(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a neural model; give one from"):
        train_blocks([], tmp_path / "b.npz", whisper=tmp_path, start=model_path("gmm"))
