"""Training of the block model: its network in PyTorch, its batches, tuning, the recipe."""

from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.errors import UserError
from kouxing.training.blocks import batches, readout
from kouxing.training.blocks.recipe import train_blocks
from kouxing.training.neural import optimizer, teacher
from kouxing.training.neural.network import ReadoutShape
from tests.unit.test_block_model import HELLO, SMALL
from tests.unit.test_neural_training import write_corpus
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL_READOUT = ReadoutShape(inner=48, gru=24, dropout=0.2, noise=0.15)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_S", 2)
    monkeypatch.setattr(batches, "_LENGTHS", (30, 40))
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 2)
    monkeypatch.setattr(readout, "READOUT", SMALL_READOUT)
    monkeypatch.setattr(readout, "BATCH_S", 3)
    monkeypatch.setattr(readout, "MAX_WINDOW_FRAMES", 80)
    monkeypatch.setattr(readout, "_FIXED_FRAMES", 50)


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
