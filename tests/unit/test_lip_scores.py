"""Scores of lips, the fit report and the pictures, on made-up speakers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.figures import new_figure, save_figure
from evaluation.lips import (
    ClipLips,
    acoustic_closures,
    clips_to_score,
    loudness_frames,
    score_clips,
)
from evaluation.viseme_fit import changes, errors_of_visemes, fit_clip, fit_figure
from evaluation.viseme_plots import dominance_figure, faces_figure, sentence_figure
from services.synthesizer.blending import blend
from services.synthesizer.parameters import clips_seen, load_parameters, save_parameters
from services.synthesizer.timeline import EDGE_S, build_timeline
from services.synthesizer.visemes import MOUTH_FAPS
from shared.audio_file import read_audio
from shared.errors import UserError
from shared.faps import NUM_FAPS
from tests.lips import clip_of, utterance
from training.lip_clips import SAMPLE_RATE_HZ
from training.viseme_start import starting_parameters

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"
START = starting_parameters()


def test_late_lips_are_found_late_and_closures_met() -> None:
    phones = utterance(1, 40)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.02)
    curve = blend(START, build_timeline(phones), time_s)
    made = np.zeros((len(time_s), NUM_FAPS))
    made[:, np.array(MOUTH_FAPS) - 1] = blend(START, build_timeline(phones), time_s - 0.05)
    true = np.zeros_like(made)
    true[:, np.array(MOUTH_FAPS) - 1] = curve
    still = np.zeros_like(made)

    centres_s = np.array([p.onset_s + min(p.duration_s / 2.0, EDGE_S) for p in phones])
    closures_s = centres_s[[phone.unit == "b" for phone in phones]]
    lips = ClipLips(
        clip_of(time_s, curve), {"late": made, "true": true, "still": still}, closures_s
    )
    scores = score_clips("all", [lips])

    late = {score.measure: score for score in scores if score.scheme == "late"}
    assert late["opening"].best_lag_ms == 50
    assert late["opening"].best_correlation == pytest.approx(1.0, abs=0.01)
    assert late["opening"].correlation is not None
    assert late["opening"].correlation < 0.95
    assert [score.correlation for score in scores if score.scheme == "still"] == [None] * 3
    found = {score.scheme: score for score in scores if score.measure == "opening"}
    assert found["true"].closures >= 3
    assert found["true"].bpm == len(closures_s) >= 3
    assert found["true"].closures_met == found["true"].closures
    assert found["true"].bpm_met == found["true"].bpm
    # a mouth that never opens closes nothing
    assert found["still"].bpm_met == found["still"].closures_met == 0
    assert found["true"].rmse < 1e-6 < found["late"].rmse


def test_what_a_clip_does_not_measure_is_not_scored() -> None:
    time_s = np.arange(0.0, 1.0, 0.04)
    jaw_only, all_faps = np.full((2, len(time_s), len(MOUTH_FAPS)), np.nan)
    all_faps[:] = jaw_only[:, MOUTH_FAPS.index(3)] = 10.0
    made = {"made": np.random.default_rng(0).normal(size=(51, NUM_FAPS))}
    lips = [ClipLips(clip_of(time_s, faps), made, np.zeros(0)) for faps in (jaw_only, all_faps)]
    found = {score.measure: score.num_clips for score in score_clips("all", lips)}
    assert found == {"opening": 1, "width": 1, "jaw": 2}
    assert [score.measure for score in score_clips("all", lips[:1])] == ["jaw"]


def test_loudness_opens_the_mouth() -> None:
    samples = np.zeros(16_000, dtype=np.float32)
    samples[6_000:10_000] = np.random.default_rng(0).normal(0.0, 0.1, 4_000)
    faps = loudness_frames(samples)
    assert faps[25, 4] < -500.0
    assert abs(faps[5, 4]) < 1.0


def test_acoustic_closures_are_where_the_unit_is_quietest() -> None:
    phones = utterance(4, 20)
    labials = [phone for phone in phones if phone.unit == "b"]
    samples = np.random.default_rng(0).normal(0.0, 0.1, 8 * SAMPLE_RATE_HZ).astype(np.float32)
    quiet_s = [phone.onset_s + 0.3 * phone.duration_s for phone in labials]
    for time_s in quiet_s:
        middle = round(time_s * SAMPLE_RATE_HZ)
        samples[middle - 200 : middle + 200] = 0.0
    clip = clip_of(np.zeros(1), np.zeros((1, len(MOUTH_FAPS))))
    object.__setattr__(clip, "samples", samples)
    np.testing.assert_allclose(acoustic_closures(clip, phones), quiet_s, atol=0.011)


def write_clip(folder: Path, name: str, column: str = "F3_open_jaw") -> None:
    (folder / f"{name}.json").write_text(json.dumps({"language": "zh", "licence": "MIT"}))
    (folder / f"{name}.csv").write_text(f"t,{column}\n0.0,1\n")
    (folder / f"{name}.flac").write_bytes(b"")


def test_clips_that_were_learnt_from_are_not_scored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "parameters.json"
    save_parameters(START, path, "a test", learnt_from=["one"], chosen_with=["two"])
    assert clips_seen(path) == {"one", "two"}
    for name in ("one", "two"):
        write_clip(tmp_path, name)
    path.rename(path.with_suffix(".text"))
    path = path.with_suffix(".text")
    monkeypatch.setattr("training.lip_clips.read_audio", lambda _path: np.zeros(1600, np.float32))
    with pytest.raises(UserError, match="give other clips"):
        clips_to_score(tmp_path, path)
    write_clip(tmp_path, "three", "F5_raise_b_midlip")
    with pytest.raises(UserError, match="no clip measures"):
        clips_to_score(tmp_path, path)
    write_clip(tmp_path, "three")
    assert [clip.name for clip in clips_to_score(tmp_path, path)] == ["three"]


def test_shipped_parameters_say_what_they_have_seen() -> None:
    seen = clips_seen()
    assert "facegood_2_04" not in seen  # held by the rule
    assert {"facegood_2_01", "facegood_2_02", "facegood_2_03"} <= seen


def test_the_fit_report_finds_who_made_the_curves() -> None:
    phones = utterance(5, 60)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.04)
    learnt = load_parameters()
    clip = clip_of(time_s, blend(learnt, build_timeline(phones), time_s))
    object.__setattr__(clip, "samples", np.zeros(int(time_s[-1] * SAMPLE_RATE_HZ), np.float32))
    fitted = [fit_clip(clip, phones, learnt, START)]
    errors = errors_of_visemes(fitted)
    assert {error.measure for error in errors} == {"opening", "width", "jaw"}
    assert {"all", "rest", "a", "i", "u", "b"} <= {error.viseme for error in errors}
    whole = next(each for each in errors if (each.viseme, each.measure) == ("all", "jaw"))
    assert whole.learnt < 0.25 * whole.guessed  # what remains is the rate
    assert whole.num_frames == len(time_s)
    changed = {(change.viseme, change.fap): change for change in changes(learnt, START)}
    assert changed["a", 3].guessed["target"] == 450.0
    assert changed["a", 3].learnt["target"] != 450.0
    assert len(fit_figure(fitted).axes) == 8
    clip.faps[:, MOUTH_FAPS.index(3)] = np.nan
    assert "jaw" not in {error.measure for error in errors_of_visemes(fitted)}
    assert len(fit_figure(fitted).axes) == 8


def test_pictures_of_visemes_are_drawn(tmp_path: Path) -> None:
    figure = faces_figure(load_parameters())
    titles = [axis.get_title() for axis in figure.axes if axis.images]
    assert len(titles) == 26
    assert titles[0] == "rest"
    faces = [np.asarray(axis.images[0].get_array()) for axis in figure.axes if axis.images]
    assert all(face.std() > 10.0 for face in faces)
    vowel = titles.index("a ang\n")
    assert np.abs(faces[vowel].astype(float) - faces[0]).max() > 60.0
    save_figure(dominance_figure(load_parameters()), tmp_path / "dominance.png")
    assert (tmp_path / "dominance.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(UserError, match="cannot be written"):
        save_figure(figure, tmp_path / "no" / "such.png")


def test_a_sentence_is_drawn_with_the_parameters_given() -> None:
    samples, _ = read_audio(DEMO / "vowels-male.wav")
    still = replace(START, target=np.zeros_like(START.target))
    for parameters, moves in ((START, True), (still, False)):
        jaw = sentence_figure(parameters, samples[:24_000, 0]).axes[1]
        full, live = (np.asarray(line.get_ydata()) for line in jaw.get_lines()[:2])
        assert (np.ptp(full) > 100.0, np.ptp(live) > 100.0) == (moves, moves)
    assert len(sentence_figure(START, np.zeros(10, np.float32)).axes) == 6


def test_pictures_without_matplotlib_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pip install"):
        new_figure(1.0, 1.0)
