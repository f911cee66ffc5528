"""Training of the block model: its network in PyTorch, its batches, tuning, the recipe."""

from functools import partial
from pathlib import Path

import pytest

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.training.blocks import batches, recipe
from kouxing.training.blocks.recipe import train_blocks
from kouxing.training.networks import optimizer, teacher
from kouxing.training.networks.network import ReadoutShape
from tests.corpora import write_noises, write_speech
from tests.system import HELLO
from tests.unit.test_block_model import SMALL
from tests.whisper_folder import encoder_arrays, write_whisper

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL_READOUT = ReadoutShape(inner=48, gru=24, dropout=0.2, noise=0.15)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "BATCH_S", 2)
    monkeypatch.setattr(batches, "_LENGTHS", (30, 40))
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 2)
    monkeypatch.setattr(recipe, "READOUT", SMALL_READOUT)
    monkeypatch.setattr(recipe, "_SUNG_EVERY", 2)
    monkeypatch.setattr(teacher, "_NUM_STEPS", 2)


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
        start=model_path("gmm"),
        untranscribed=[corpus],
        sounds=[write_noises(tmp_path / "sounds")],
        any_license=False,
    )
    with monkeypatch.context() as patch:
        patch.setattr(recipe, "export_onnx", interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(num_steps=2)
    train(num_steps=3)
    assert "resuming after step 2" in capsys.readouterr().err
    model = load_model(output)
    assert isinstance(model, BlockModel)
    stream = model.create_stream()
    frames = WhisperMel().accept_waveform(HELLO)
    assert len(stream.score(frames)) + len(stream.score(None)) == len(frames)
    card = output.with_suffix(".md").read_text()
    assert "3 steps of 256 s of sound, aligned by `gmm.npz`, on 8 recordings" in card
    assert "CC0-1.0" in card
    left = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert left == {"blocks.npz", "blocks.md"}


def interrupt(*_arguments: object) -> None:
    raise KeyboardInterrupt
