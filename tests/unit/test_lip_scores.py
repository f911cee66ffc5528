"""Scores of lips and the fit report, on artificial clips."""

import json
from collections.abc import Collection, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from kouxing.corpora.figures import new_figure
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.evaluation.lips.report import print_scores
from kouxing.evaluation.lips.schemes import (
    DEFAULT_DELAY_S,
    DELAYS_S,
    RecognizedClip,
    Scheme,
    is_speech,
    live_events,
)
from kouxing.evaluation.lips.scores import LipScore, clips_to_score, pool, score_clip
from kouxing.evaluation.lips.viseme_fit import fit_clip, fit_figure, viseme_errors
from kouxing.services.live_chain import sound_events
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import clips_seen, load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import EDGE_S, build_timeline
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import LipPositions, Phone, SoundEvent, SpeechChange
from kouxing.training.visemes.recipe import save_parameters
from tests.lips import INVENTORY, clip_of, utterance
from tests.system import VOWELS_FILE

DEMO = Path(__file__).parents[2] / "shared" / "demo"
START = initial_parameters()
MOUTH = np.array(MOUTH_FAPS) - 1


def recognized(
    clip: LipClip, phones: Sequence[Phone] = (), events: Sequence[SoundEvent] = ()
) -> RecognizedClip:
    return RecognizedClip(
        clip=clip,
        num_frames=0,
        levels=level_track(clip.samples),
        events={delay_s: list(events) for delay_s in DELAYS_S},
        inventory=INVENTORY,
        recognized=list(phones),
        aligned=None,
    )


def make_scheme(name: str, frames: NDArray[np.float64], delay_s: float = 0.05) -> Scheme:
    return Scheme(name, delay_s, lambda _clip: frames)


def scores_of(lips: RecognizedClip, schemes: dict[str, NDArray[np.float64]]) -> list[LipScore]:
    """Score made frames under their names."""
    results = [score_clip(lips, make_scheme(name, frames)) for name, frames in schemes.items()]
    return pool([score for score in results if score is not None])


def test_measures_lag_openings_and_closures() -> None:
    phones = utterance(1, 40)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.02)
    true, made, still = np.zeros((3, len(time_s), NUM_FAPS))
    for frames, delay_s in ((true, 0.0), (made, 0.05)):
        frames[:, MOUTH] = blend(START, build_timeline(phones, INVENTORY), time_s - delay_s)
    curve = true[:, MOUTH]

    # quietest where the lips of a b are: half way, or at its edge
    samples = np.full(int(time_s[-1] * SAMPLE_RATE_HZ), 0.1, dtype=np.float32)
    for phone in phones:
        apex = round(SAMPLE_RATE_HZ * (phone.onset_s + min(phone.duration_s / 2.0, EDGE_S)))
        samples[apex - 160 : apex + 160] = 0.0
    clip = replace(clip_of(time_s, curve), samples=samples)
    scores = scores_of(recognized(clip, phones), {"late": made, "true": true, "still": still})
    groups = {("all", "all"), ("language", "zh"), ("source", "made"), ("speaker", "nobody")}
    assert {(score.kind, score.group) for score in scores} == groups
    by_scheme = {score.scheme: score for score in scores if score.kind == "all"}
    late, same, rest = (by_scheme[name] for name in ("late", "true", "still"))

    opening = late.curves["opening"]
    assert opening.best_lag_ms == 50
    assert opening.best_correlation == pytest.approx(1.0, abs=0.01)
    assert (opening.correlation or 0.0) < 0.95
    assert (opening.rmse or 0.0) > 1e-3 > (same.curves["opening"].rmse or 0.0)
    assert late.opening_delay_p50_ms == pytest.approx(50.0, abs=2.0)
    assert late.opening_delay_p95_ms == pytest.approx(50.0, abs=5.0)
    assert same.opening_delay_p95_ms == pytest.approx(0.0)
    assert same.openings_met == same.openings >= 5
    assert same.closures.real >= 3
    assert same.closures.recall == 1.0
    assert same.bpm == same.bpm_met == sum(phone.symbol == "b" for phone in phones) >= 3
    # a mouth that never opens closes nothing
    assert [curve.correlation for curve in rest.curves.values()] == [None] * 3
    assert rest.bpm_met == rest.closures.met == rest.closures.made == rest.closures.f1 == 0

    out_of_sync = recognized(replace(clip, is_in_sync=False), phones)
    score = scores_of(out_of_sync, {"true": true})[0]
    assert score.curves["opening"].correlation == pytest.approx(1.0)
    assert score.curves["opening"].best_lag_ms is None
    assert score.closures.real == score.openings == score.bpm == 0


def test_speech_is_loud_voice_activity() -> None:
    samples = np.full(3 * SAMPLE_RATE_HZ, 0.1, dtype=np.float32)
    samples[SAMPLE_RATE_HZ : 2 * SAMPLE_RATE_HZ] = 1e-4  # a pause that voice activity spans
    clip = replace(clip_of(np.zeros(1), np.zeros((1, len(MOUTH_FAPS)))), samples=samples)
    events = [SpeechChange(active=True, time_s=0.5), SpeechChange(active=False, time_s=2.5)]
    times_s = np.array([0.2, 0.6, 1.05, 1.5, 1.95, 2.4, 2.6])
    results = is_speech(recognized(clip, events=events), times_s)
    assert results.tolist() == [False, True, True, False, True, True, False]
    assert not is_speech(recognized(clip), times_s).any()


def test_counts_closures_in_speech_separately() -> None:
    time_s = np.arange(0.0, 4.0, 0.02)
    frames = np.zeros((len(time_s), NUM_FAPS))
    frames[:, 4] = -300.0
    for moment_s in (0.5, 1.5, 3.5):
        frames[np.abs(time_s - moment_s) < 0.05] = 0.0
    clip = clip_of(time_s, frames[:, MOUTH])
    samples = np.full(4 * SAMPLE_RATE_HZ, 0.1, dtype=np.float32)
    events = [SpeechChange(active=True, time_s=0.0), SpeechChange(active=False, time_s=2.0)]
    lips = recognized(replace(clip, samples=samples), events=events)
    score = scores_of(lips, {"made": frames})[0]
    assert (score.closures.met, score.closures.real, score.closures.made) == (3, 3, 3)
    spoken = score.closures_in_speech
    assert (spoken.met, spoken.real, spoken.true, spoken.made) == (2, 2, 2, 2)


def test_prints_scores_by_group() -> None:
    time_s = np.arange(0.0, 2.0, 0.04)
    rng = np.random.default_rng(0)
    clip = clip_of(time_s, rng.normal(0.0, 100.0, (len(time_s), len(MOUTH_FAPS))))
    frames = rng.normal(0.0, 100.0, (101, NUM_FAPS))
    results = [
        score_clip(
            recognized(replace(clip, speaker=speaker, language=language)),
            make_scheme("dynamic-visemes", frames, DEFAULT_DELAY_S),
        )
        for speaker, language in (("one", "zh"), ("somebody_with_a_name", "en"))
    ]
    scores = pool([score for score in results if score is not None])
    console = Console(record=True, width=80, file=StringIO())
    print_scores(scores, console)
    text = console.export_text()
    for name in ("all: 2", "zh: 1", "en: 1"):
        assert name in text
    opening = next(score for score in scores if score.kind == "all").curves["opening"]
    assert f"{opening.correlation:.2f}" in text
    assert "…" not in text  # nothing is cut off in 80 columns


def write_clip(folder: Path, name: str, column: str = "F3_open_jaw", language: str = "zh") -> None:
    (folder / f"{name}.json").write_text(json.dumps({"language": language, "licence": "MIT"}))
    (folder / f"{name}.csv").write_text(f"t,{column}\n0.0,1\n")
    (folder / f"{name}.flac").write_bytes(b"")


@pytest.mark.slow
def test_one_recognizer_run_serves_all_delays() -> None:
    model = load_model()
    samples = read_audio(VOWELS_FILE)[0][:, 0]
    lips = lip_predictor_for(model)
    results = live_events(model, samples, lips, DELAYS_S)
    assert list(results) == DELAYS_S
    alone = sound_events(model, samples, lips, DEFAULT_DELAY_S)
    assert len(alone) == len(results[DEFAULT_DELAY_S]) > 200
    for event, other in zip(alone, results[DEFAULT_DELAY_S], strict=True):
        if isinstance(event, LipPositions) and isinstance(other, LipPositions):
            assert (event.time_s, event.delay_s) == (other.time_s, other.delay_s)
            np.testing.assert_allclose(event.faps, other.faps, rtol=1e-4, atol=1e-3)
        else:
            assert event == other
    delays = [{e.delay_s for e in results[d] if isinstance(e, LipPositions)} for d in DELAYS_S]
    assert all(len(each) == 1 for each in delays)
    assert delays[0] != delays[-1]
    assert live_events(model, samples, None, DELAYS_S)[0.0] == sound_events(model, samples)


def test_skips_clips_used_for_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parameters = tmp_path / "parameters.text"
    save_parameters(START, parameters, "a test", learnt_from=["a_one"], chosen_with=["a_two"])
    assert clips_seen(parameters) == {"a_one", "a_two"}
    clips = tmp_path / "clips"
    clips.mkdir()
    for name in ("a_one", "a_two"):
        write_clip(clips, name)
    monkeypatch.setattr(
        "kouxing.corpora.lip_clips.read_audio", lambda _path: np.zeros(1600, np.float32)
    )
    with pytest.raises(UserError, match=r"held\.txt"):
        clips_to_score(clips, parameters)
    (clips / "held.txt").write_text("a_one a_two a_three b_four")
    with pytest.raises(UserError, match="trained on all clips"):
        clips_to_score(clips, parameters)
    write_clip(clips, "a_three", "F12_raise_l_cornerlip")
    with pytest.raises(UserError, match="no clip measures"):
        clips_to_score(clips, parameters)
    write_clip(clips, "a_three")
    write_clip(clips, "b_four", language="en")

    def names(sources: Collection[str] = (), language: str | None = None) -> list[str]:
        results = clips_to_score(clips, parameters, language=language, sources=sources)
        return [clip.name for clip in results]

    assert names() == ["a_three", "b_four"]
    assert names(language="zh") == ["a_three"]
    assert names(["b"]) == ["b_four"]
    with pytest.raises(UserError, match="no clip is from c"):
        names(["c"])


def test_learnt_parameters_fit_their_own_curves_best() -> None:
    phones = utterance(5, 60)
    time_s = np.arange(0.0, phones[-1].onset_s + 1.0, 0.04)
    learnt = load_parameters()
    clip = clip_of(time_s, blend(learnt, build_timeline(phones, INVENTORY), time_s))
    object.__setattr__(clip, "samples", np.zeros(int(time_s[-1] * SAMPLE_RATE_HZ), np.float32))
    lips = [DynamicVisemes(parameters, INVENTORY) for parameters in (learnt, START)]
    fitted = [fit_clip(clip, phones, *lips)]
    errors = viseme_errors(fitted)
    assert {error.measure for error in errors} == {"opening", "width", "jaw"}
    assert {"all", "rest", "a", "i", "u", "b"} <= {error.viseme for error in errors}
    whole = next(each for each in errors if (each.viseme, each.measure) == ("all", "jaw"))
    assert whole.learnt < 0.25 * whole.guessed  # the frame rate causes the remaining error
    assert whole.num_frames == len(time_s)
    assert len(fit_figure(fitted).axes) == 8
    clip.faps[:, MOUTH_FAPS.index(3)] = np.nan
    assert "jaw" not in {error.measure for error in viseme_errors(fitted)}
    assert len(fit_figure(fitted).axes) == 8


def test_figures_need_matplotlib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(UserError, match="pip install"):
        new_figure(1.0, 1.0)
