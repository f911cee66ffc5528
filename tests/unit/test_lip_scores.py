"""The commands that compare lips with real ones, and their measures."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from kouxing.corpora.figures import new_figure
from kouxing.evaluation.commands import app
from kouxing.evaluation.lips.lip_measures import MEASURES, REAL_MEASURES
from kouxing.evaluation.lips.lip_scores import groups_of
from kouxing.evaluation.lips.references import clips_to_score
from kouxing.evaluation.lips.speaking_rates import accuracy_of
from kouxing.evaluation.recognizer.disturbances import CLEAN, MUSIC
from kouxing.services.synthesizer.lips.ferguson.contour import opening_to_faps
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.lip_clips import write_held_out_clip
from tests.lips import clip_of


def test_the_command_compares_faces_with_the_real_lips(tmp_path: Path) -> None:
    write_held_out_clip(tmp_path)
    path = tmp_path / "scores.json"
    options = ["--lips", "learned", "--delay-ms", "0", "--delay-ms", "60"]
    conditions = ["--condition", CLEAN, "--condition", MUSIC]
    arguments = ["lips", "--clips", str(tmp_path), *options, *conditions, "--json", str(path)]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    results = json.loads(path.read_text(encoding="utf-8"))
    assert [*results] == ["real", "learned, 0 ms", "learned, 60 ms"]
    groups = {"all", "zh", "zh new", "source cam", "speaker ann"}
    assert {*results["real"][CLEAN]} == groups
    assert {*results["real"][CLEAN]["all"]} == {"clips", *REAL_MEASURES}
    for title in ("learned, 0 ms", "learned, 60 ms"):
        assert {*results[title][CLEAN]} == groups
        assert {*results[title][MUSIC]} == groups
        assert {*results[title][CLEAN]["all"]} == {"clips", *MEASURES}
    assert results["learned, 0 ms"][CLEAN]["all"] != results["learned, 60 ms"][CLEAN]["all"]
    assert "1: learned, 0 ms, 2: learned, 60 ms" in result.output


def test_omitted_clips_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_held_out_clip(tmp_path)
    for suffix in (".flac", ".json"):
        shutil.copy(tmp_path / f"cam_1{suffix}", tmp_path / f"cam_2{suffix}")
    (tmp_path / "cam_2.csv").write_text("t,F16_push_b_lip\n0.00,10\n0.04,20")
    assert [clip.name for clip in clips_to_score(tmp_path)] == ["cam_1"]
    assert capsys.readouterr().err == (
        "omitted 1 clip without a lip opening (FAP 4 and 5): cam_2\n"
    )


def test_groups_clips_by_language_speaker_and_source() -> None:
    clip = clip_of(np.zeros(1), np.zeros((1, 28)))
    common = ["source made", "speaker nobody"]
    assert groups_of(clip, set()) == ["all", "zh", "zh new", *common]
    assert groups_of(clip, {"nobody"}) == ["all", "zh", "zh known", *common]


def test_figures_need_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pip install"):
        new_figure(1.0, 1.0)


def test_accuracy_is_one_minus_the_relative_error_of_the_measured_heights() -> None:
    real = opening_to_faps(np.array([0.0, 1.0, 2.0, 4.0, 5.0, 3.0]))
    assert accuracy_of(real, real) == pytest.approx(1.0)
    assert accuracy_of(-real, real) == pytest.approx(-1.0)
    scaled = 0.75 * real
    real[2] = np.nan
    real[:, MOUTH_FAPS.index(52)] = np.nan
    scaled[:, MOUTH_FAPS.index(3)] = 1e4  # the jaw is no lip
    scaled[:, MOUTH_FAPS.index(6)] = 1e4  # the paper moves lips vertically
    assert accuracy_of(scaled, real) == pytest.approx(0.75)
