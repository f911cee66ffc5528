"""Training of the universal readout: the recordings, their alignment, the recipe."""

from functools import partial
from pathlib import Path

import pytest
import soundfile

from kouxing.services.recognizer.acoustic.acoustic_model import score_segment
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.training.networks import optimizer
from kouxing.training.universal import alignment, recipe, trainer
from kouxing.training.universal.recipe import train_universal
from tests.corpora import interrupt, write_manifest
from tests.system import HELLO

pytestmark = pytest.mark.usefixtures("one_thread")

COLUMNS = "utt_id path language speaker license split seconds text ipa phones_path"


@pytest.fixture(autouse=True)
def _short_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alignment, "_STEPS", 20)
    monkeypatch.setattr(alignment, "_MIN_LABELED", 1)
    monkeypatch.setattr(optimizer, "SAVE_EVERY", 1)
    monkeypatch.setattr(trainer, "_NUM_CROPS", 2)


def write_corpus(folder: Path) -> Path:
    folder.mkdir()
    soundfile.write(folder / "a.wav", HELLO, 16_000)
    labels = [("0", "0.2", "<p:>"), ("0.2", "0.6", "a"), ("0.6", "1.4", "aI"), ("1.4", "1.5", "n")]
    table = ["start_s\tend_s\tsymbol", *map("\t".join, labels)]
    (folder / "labels.tsv").write_text("\n".join(table) + "\n")
    common = {"path": "a.wav", "license": "CC0", "seconds": "1.5", "text": "-"}
    rows: list[dict[str, str]] = [
        {"utt_id": "b", "language": "fr", "speaker": "b", "ipa": "nina sa"},
        {"utt_id": "c", "language": "it", "speaker": "c", "ipa": "mama"},  # held out
        {"utt_id": "d", "language": "de", "speaker": "emodb_03", "ipa": "mama"},  # held out
        {"utt_id": "emodb_a", "language": "de", "speaker": "emodb_08", "phones_path": "labels.tsv"},
    ]
    cells = ["\t".join((common | row).get(name, "") for name in COLUMNS.split()) for row in rows]
    write_manifest(folder, COLUMNS, cells)
    return folder


@pytest.mark.slow
def test_trains_resumes_and_writes_model_and_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "universal.npz"
    languages = [write_corpus(tmp_path / "corpus")]
    train = partial(
        train_universal, [], output, learners=[], languages=languages, clips=None, any_license=False
    )
    interrupt(recipe, "export_extension", partial(train, num_steps=1))
    train(num_steps=2)
    assert "resuming after step 1" in capsys.readouterr().err
    model = load_model(output)
    assert model.inventory.language == "universal"
    frames = WhisperMel().accept_waveform(HELLO)
    assert len(score_segment(model, frames)) == len(frames)
    card = output.with_suffix(".md").read_text()
    assert "| CC0 | 2 | 2 | 0.1 |" in card
    assert {path.name for path in tmp_path.iterdir()} == {"universal.npz", "universal.md", "corpus"}
