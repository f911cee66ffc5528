"""Training lips from sound, on made-up speakers."""

from pathlib import Path

import pytest

from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.shared.errors import UserError
from kouxing.training.lips.recipe import DELAYS_S, train_lips
from tests.lip_clips import clip_name_for, write_training_clip


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_writes_a_model_and_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, output = tmp_path / "clips", tmp_path / "lips.npz"
    folder.mkdir()
    write_training_clip(folder, clip_name_for("train"), "anna", "CC0")
    write_training_clip(folder, clip_name_for("choice"), "berta", "MIT")
    write_training_clip(folder, clip_name_for("held"), "clara", "CC0")
    write_training_clip(folder, "closed", "dora", "academic use only")
    train_lips(folder, output, any_license=False)
    assert load_lip_predictor(output).delays_s == DELAYS_S
    card = output.with_suffix(".md").read_text()
    assert "| CC0 | 1 | 1 | 0.0 |" in card
    assert "| MIT | 1 | 1 | 0.0 |" in card
    assert "academic" not in card
    assert "gated recurrent unit" in card


def test_rejects_clips_without_a_free_license(tmp_path: Path) -> None:
    write_training_clip(tmp_path, "closed", "dora", "academic use only")
    with pytest.raises(UserError, match=r"no clip .* has a license that allows training"):
        train_lips(tmp_path, tmp_path / "lips.npz", any_license=False)
