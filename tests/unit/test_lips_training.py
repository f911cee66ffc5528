"""Training lips from sound, on made-up speakers."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, split_of
from kouxing.services.recognizer.lip_predictor import load_lip_predictor
from kouxing.shared.errors import UserError
from kouxing.training.lips.recipe import DELAYS_S, train_lips
from tests.system import VOWELS_FILE, samples_of_file

FRAME_S = 0.04


def write_clip(folder: Path, name: str, speaker: str, license_name: str) -> None:
    samples = samples_of_file(VOWELS_FILE)[: 2 * SAMPLE_RATE_HZ]
    soundfile.write(folder / f"{name}.flac", samples, SAMPLE_RATE_HZ)
    about = {"speaker": speaker, "licence": license_name, "language": "en"}
    (folder / f"{name}.json").write_text(json.dumps(about))
    rows = [
        f"{k * FRAME_S},{100 + 50 * np.sin(k)},0,{-200 - 100 * np.sin(k)},{5 * np.cos(k)},0"
        for k in range(50)
    ]
    head = "t,F3_open_jaw,F4_upper,F5_lower,F6_left,F7_right"
    (folder / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")


def name_for(split: str) -> str:
    """Return a name that the rule puts into this split."""
    return next(name for k in range(100) if split_of(name := f"clip_{k}", may_train=True) == split)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_writes_a_model_and_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, output = tmp_path / "clips", tmp_path / "lips.npz"
    folder.mkdir()
    write_clip(folder, name_for("train"), "anna", "CC0")
    write_clip(folder, name_for("choice"), "berta", "MIT")
    write_clip(folder, name_for("held"), "clara", "CC0")
    write_clip(folder, "closed", "dora", "academic use only")
    train_lips(folder, output, any_license=False)
    assert load_lip_predictor(output).delays_s == DELAYS_S
    card = output.with_suffix(".md").read_text()
    assert "| CC0 | 1 | 1 | 0.0 |" in card
    assert "| MIT | 1 | 1 | 0.0 |" in card
    assert "academic" not in card
    assert "gated recurrent unit" in card


def test_rejects_clips_without_a_free_license(tmp_path: Path) -> None:
    write_clip(tmp_path, "closed", "dora", "academic use only")
    with pytest.raises(UserError, match=r"no clip .* may be used"):
        train_lips(tmp_path, tmp_path / "lips.npz", any_license=False)
