"""Training of the block model: its network in PyTorch, its batches, tuning, the recipe."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.training.blocks import batches, recipe
from kouxing.training.blocks.recipe import train_blocks
from kouxing.training.networks import labels, optimizer, teacher
from kouxing.training.networks.labels import STATES_PER_PHONE
from kouxing.training.networks.network import ReadoutShape
from kouxing.training.training_set import load_examples
from tests.block_networks import SMALL
from tests.corpora import interrupt, write_noises, write_speech
from tests.system import HELLO
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL_READOUT = ReadoutShape(inner=48, gru=24, dropout=0.2, noise=0.15)


@pytest.fixture(autouse=True)
def _short_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_S", 2)
    monkeypatch.setattr(batches, "_LENGTHS", (30, 40))
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 2)
    monkeypatch.setattr(recipe, "READOUT", SMALL_READOUT)
    monkeypatch.setattr(recipe, "_SUNG_EVERY", 2)
    monkeypatch.setattr(teacher, "_NUM_STEPS", 2)


@pytest.mark.parametrize("name", ["blocks", "gmm"])  # with three and with five states per phone
def test_each_phone_of_a_text_is_aligned_with_three_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    corpus, model = write_speech(tmp_path / "corpus", {"a": HELLO}), load_model(name)
    examples = load_examples([corpus], RowErrors(), model.inventory, any_license=False)
    (example,), (alignment,) = labels._align_examples(model, examples)
    states = alignment.states[np.diff(alignment.states, prepend=-1) != 0]
    silence = model.inventory.index[model.inventory.silence]
    assert states[states // STATES_PER_PHONE != silence].tolist() == [
        STATES_PER_PHONE * phone + place
        for phone in example.phones
        for place in range(STATES_PER_PHONE)
    ]


@pytest.mark.slow
def test_trains_resumes_and_writes_model_and_card(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("kouxing.training.networks.whisper.EncoderShape", SMALL)
    corpus = write_speech(tmp_path / "corpus", {"a": HELLO, "b": HELLO, "d": HELLO})
    output = tmp_path / "blocks.npz"
    train = partial(
        train_blocks,
        [corpus],
        output,
        whisper=write_whisper(tmp_path / "whisper", encoder_arrays(num_layers=6)),
        start=None,
        untranscribed=[corpus],
        sounds=[write_noises(tmp_path / "sounds")],
        any_license=False,
    )
    interrupt(recipe, "export_onnx", partial(train, num_steps=2))
    train(num_steps=3)
    assert "resuming after step 2" in capsys.readouterr().err
    model = load_model(output)
    assert isinstance(model, BlockModel)
    stream = model.create_stream()
    frames = WhisperMel().accept_waveform(HELLO)
    assert len(stream.score(frames)) + len(stream.score(None)) == len(frames)
    card = output.with_suffix(".md").read_text()
    assert "3 steps of 256 s of audio, aligned by `blocks.npz`, on 8 recordings" in card
    assert "CC0-1.0" in card
    left = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert left == {"blocks.npz", "blocks.md"}
