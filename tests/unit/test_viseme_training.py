"""Learning viseme parameters and scoring lips, on made-up speakers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from evaluation.lips import loudness_frames, score_clips
from services.synthesizer.blending import blend
from services.synthesizer.timeline import build_timeline
from services.synthesizer.visemes import MOUTH_FAPS, VISEME_INDEX
from shared.errors import UserError
from shared.faps import NUM_FAPS
from shared.phones import Phone
from training.visemes import (
    LipClip,
    estimate,
    frames_of,
    read_clips,
    starting_parameters,
    train,
)

pytestmark = pytest.mark.unit

JAW, LOWER_LIP, WIDTH = (MOUTH_FAPS.index(fap) for fap in (3, 5, 6))
START = starting_parameters()


def utterance(seed: int, num_units: int) -> list[Phone]:
    rng = np.random.default_rng(seed)
    onset_s, phones = 0.3, []
    for index in range(num_units):
        unit = str(rng.choice(["d", "g", "sh", "b"] if index % 2 == 0 else ["a", "i", "u"]))
        duration_s = float(rng.uniform(0.06, 0.25))
        phones.append(
            Phone(
                index=index,
                unit=unit,
                onset_s=onset_s,
                duration_s=duration_s,
                confidence=1.0,
                final=True,
            )
        )
        onset_s += duration_s + (0.5 if rng.random() < 0.15 and index % 2 else 0.0)
    return phones


def clip_of(time_s: np.ndarray, faps: np.ndarray) -> LipClip:
    return LipClip(
        name="made_up",
        speaker="nobody",
        licence="CC0",
        is_rig=False,
        is_held=False,
        transcript="",
        time_s=time_s,
        faps=faps,
        samples=np.zeros(0, dtype=np.float32),
    )


def test_estimation_finds_what_made_the_curves() -> None:
    phones = utterance(0, 160)
    time_s = np.arange(0.0, phones[-1].onset_s + 0.5, 0.04)
    true = replace(START, target=0.6 * START.target, offset_s=START.offset_s - 0.02)
    true.target[VISEME_INDEX["i"], JAW] = 150.0  # this speaker's own
    faps = np.full((len(time_s), len(MOUTH_FAPS)), np.nan)
    measured = [JAW, LOWER_LIP, WIDTH]
    curve = blend(true, build_timeline(phones), time_s)
    faps[:, measured] = curve[:, measured]

    found = estimate(frames_of([clip_of(time_s, faps)], [phones]))

    again = blend(found, build_timeline(phones), time_s)
    before = blend(START, build_timeline(phones), time_s)
    for column in measured:
        error, start_error = (
            float(np.sqrt(np.mean((each[:, column] - curve[:, column]) ** 2)))
            for each in (again, before)
        )
        assert error < 0.35 * start_error
    assert found.target[VISEME_INDEX["i"], JAW] == pytest.approx(150.0, rel=0.2)
    assert found.target[VISEME_INDEX["a"], JAW] == pytest.approx(270.0, rel=0.2)
    assert found.offset_s[VISEME_INDEX["a"], JAW] == pytest.approx(-0.02, abs=0.015)
    # what was not measured, and what is closed by definition, stays
    np.testing.assert_array_equal(
        found.target[:, MOUTH_FAPS.index(45)], START.target[:, MOUTH_FAPS.index(45)]
    )
    assert found.target[VISEME_INDEX["b"], LOWER_LIP] == 0.0


def test_late_lips_are_found_late_and_closures_met() -> None:
    phones = utterance(1, 40)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.02)
    curve = blend(START, build_timeline(phones), time_s)
    made = np.zeros((len(time_s), NUM_FAPS))
    made[:, np.array(MOUTH_FAPS) - 1] = blend(START, build_timeline(phones), time_s - 0.05)
    still = np.zeros_like(made)

    scores = score_clips([clip_of(time_s, curve)], [{"late": made, "still": still}])

    late = {score.measure: score for score in scores if score.scheme == "late"}
    assert late["opening"].best_lag_ms == 50
    assert late["opening"].best_correlation == pytest.approx(1.0, abs=0.01)
    assert late["opening"].correlation < 0.95
    assert late["opening"].closures >= 3
    assert late["opening"].closures_met == late["opening"].closures
    assert [score.correlation for score in scores if score.scheme == "still"] == [0.0, 0.0, 0.0]


def test_loudness_opens_the_mouth() -> None:
    samples = np.zeros(16_000, dtype=np.float32)
    samples[6_000:10_000] = np.random.default_rng(0).normal(0.0, 0.1, 4_000)
    faps = loudness_frames(samples)
    assert faps[25, 4] < -500.0
    assert abs(faps[5, 4]) < 1.0


def write_clip(folder: Path, name: str, language: str, header: str, row: str) -> None:
    (folder / f"{name}.json").write_text(
        json.dumps({"language": language, "speaker": "one", "licence": "MIT", "transcript": ""})
    )
    (folder / f"{name}.csv").write_text(f"{header}\n{row}\n")
    soundfile.write(folder / f"{name}.flac", np.zeros(1600), 16_000)


def test_clips_of_both_kinds_are_read(tmp_path: Path) -> None:
    write_clip(tmp_path, "a_film", "zh", "t,ok,F3_open_jaw,F5_raise_b_midlip", "0.5,1,10,-20")
    write_clip(
        tmp_path, "b_rig", "zh", "t,mouth_stretch_c,mouth_press_l,mouth_press_r", "0.5,1,0,0"
    )
    write_clip(tmp_path, "c_english", "en", "t,ok", "0,1")
    (tmp_path / "held.txt").write_text("a_film\n")
    with pytest.raises(UserError, match="b_rig"):  # shapes of the rig are missing
        read_clips(tmp_path)
    (tmp_path / "b_rig.json").unlink()
    (film,) = read_clips(tmp_path)
    assert film.is_held
    assert not film.is_rig
    assert film.faps[0, [JAW, LOWER_LIP]].tolist() == [10.0, -20.0]
    assert np.isnan(film.faps[0, WIDTH])


def test_folders_without_clips_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no Mandarin clips"):
        train(tmp_path, tmp_path / "out.json")
