"""Learning viseme parameters, on made-up speakers."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.corpora.lip_clips import read_clips
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.inventory import load_inventory
from kouxing.training.visemes.fit import collect_frames, fit_parameters
from tests.lips import JAW, LOWER_LIP, WIDTH, clip_of, utterance

INVENTORY = load_inventory()

START = initial_parameters()


@pytest.mark.slow
def test_estimates_the_parameters_behind_curves() -> None:
    phones = utterance(0, 100)
    time_s = np.arange(0.0, phones[-1].onset_s + 0.5, 0.04)
    true = replace(START, target=0.6 * START.target, offset_s=START.offset_s - 0.02)
    true.target[VISEME_INDEX["i"], JAW] = 150.0  # this speaker's own
    faps = np.full((len(time_s), len(MOUTH_FAPS)), np.nan)
    measured = [JAW, LOWER_LIP, WIDTH]
    curve = blend(true, build_timeline(phones, INVENTORY), time_s)
    faps[:, measured] = curve[:, measured]

    fitted = fit_parameters(collect_frames([clip_of(time_s, faps)], [phones], INVENTORY))

    again = blend(fitted, build_timeline(phones, INVENTORY), time_s)
    before = blend(START, build_timeline(phones, INVENTORY), time_s)
    for column in measured:
        error, start_error = (
            float(np.sqrt(np.mean((faps[:, column] - curve[:, column]) ** 2)))
            for faps in (again, before)
        )
        assert error < 0.35 * start_error
    assert fitted.target[VISEME_INDEX["i"], JAW] == pytest.approx(150.0, rel=0.2)
    assert fitted.target[VISEME_INDEX["a"], JAW] == pytest.approx(270.0, rel=0.2)
    assert fitted.offset_s[VISEME_INDEX["a"], JAW] == pytest.approx(-0.02, abs=0.015)
    # what was not measured, and what is closed by definition, stays
    np.testing.assert_array_equal(
        fitted.target[:, MOUTH_FAPS.index(45)], START.target[:, MOUTH_FAPS.index(45)]
    )
    assert fitted.target[VISEME_INDEX["b"], LOWER_LIP] == 0.0
    assert fitted.offset_s[VISEME_INDEX["b"], LOWER_LIP] == 0.0


def write_clip(folder: Path, name: str, language: str, header: str, row: str) -> None:
    about = {"language": language, "speaker": "one", "license": "MIT", "energy_r": math.nan}
    (folder / f"{name}.json").write_text(json.dumps(about))  # the last one is not used
    (folder / f"{name}.csv").write_text(f"{header}\n{row}\n")
    soundfile.write(folder / f"{name}.flac", np.zeros(1600), 16_000)


def test_reads_tracked_clips_and_rigs(tmp_path: Path) -> None:
    write_clip(tmp_path, "a_film", "zh", "t,ok,F3_open_jaw,F5_raise_b_midlip", "0.5,1,10,-20")
    write_clip(
        tmp_path, "b_rig", "zh", "t,mouth_stretch_c,mouth_press_l,mouth_press_r", "0.5,1,0,0"
    )
    write_clip(tmp_path, "c_english", "en", "t,ok", "0,1")
    (tmp_path / "held.txt").write_text("a_film\n")
    with pytest.raises(UserError, match="b_rig"):  # shapes of the rig are missing
        read_clips(tmp_path)
    (tmp_path / "b_rig.json").unlink()
    (tmp_path / "results.json").write_text("[]")  # not a clip
    (film,) = read_clips(tmp_path)
    assert film.split == "held"
    assert film.faps[0, [JAW, LOWER_LIP]].tolist() == [10.0, -20.0]
    assert np.isnan(film.faps[0, WIDTH])


@pytest.mark.parametrize(
    ("about", "table", "message"),
    [
        ("{", "t,F3_open_jaw\n0,1\n", "property name"),
        ("{}", "", "no rows"),
        ("{}", "F3_open_jaw\n1\n", "it lacks 't'"),
        ("{}", "t,F3_open_jaw\n0,x\n", "'x'"),
        ("{}", "t,F3_open_jaw\n0,1\n0,1\n", "are not increasing"),
        ("{}", "t,F1_viseme\n0,1\n", "no FAP of the mouth"),
        ("{}", "t,mouth_stretch_c\n0,1\n", "it lacks 'mouth_lowerLipDepress'"),
        ("{}", "t,F3_open_jaw\n0,1\n", "bad.flac"),
    ],
)
def test_rejects_bad_clips(about: str, table: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text(about)
    (tmp_path / "bad.csv").write_text(table)
    with pytest.raises(UserError, match=f"bad.*{message}"):
        read_clips(tmp_path)
