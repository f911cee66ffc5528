"""Score lip models on clips with tracked lips.

The schemes (``schemes.py``) run the same code as the services, on held-out clips. Results are
pooled over all frames of a group of clips: all, a language, a source, a speaker.

- Correlation of opening, width and jaw, after removal of each clip's mean, because a tracked face
  at rest is never exactly at 0. It is measured over everything, in speech only (``is_speech``), and
  with drift below 1 Hz removed.
- The lag with the highest correlation, positive if the made lips are late; the error in FAP units.
- Closures: recall, precision and F1 (``measures.py``), also in speech only, because lips that close
  after each word are nearly always right. Contacts of lower lip and upper teeth. How many b p m
  close: the lips must close within 40 ms of the phone's quietest moment. The phones come from
  forced alignment or, without a transcript, from offline decoding.
- Turns: sign changes of the velocity per second, for made and real lips, at the video's frame rate
  and at 50 Hz. Tracked lips tremble; smooth ones, of an animator's rig, are the stricter measure.
- The time from a real opening to the made one. The face's delay comes on top.
- Pauses of half a second and more: the RMS velocity of the opening, and the time from the last
  sound to closed lips.

Clips that are out of sync count only for shapes, not for lags, events and pauses.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.evaluation.lips.clip_scores import (
    LAGS_S,
    MEASURES,
    ClipScore,
    CurveSums,
    EventSums,
    PauseSums,
    is_measured,
    score_clip,
)
from kouxing.evaluation.lips.measures import Detections, best_lag
from kouxing.evaluation.lips.schemes import all_schemes, recognize_clip
from kouxing.services.lip_models import lip_models
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import clips_seen, load_parameters
from kouxing.shared.errors import UserError


@dataclass(slots=True, kw_only=True)
class CurveScore:
    """One measure of the mouth; None if nothing moves or nothing was measured."""

    correlation: float | None
    correlation_in_speech: float | None
    correlation_without_drift: float | None
    best_lag_ms: float | None  # positive: late
    best_correlation: float | None
    rmse: float | None  # FAP units, clip means removed
    turns_per_s: float | None  # at the video's frame rate
    turns_per_s_at_50_hz: float | None
    real_turns_per_s: float | None


@dataclass(slots=True, kw_only=True)
class HitScore:
    """Detected events."""

    real: int
    met: int  # real events that are reproduced
    made: int
    true: int  # made events that are right
    recall: float | None
    precision: float | None
    f1: float | None


@dataclass(slots=True, kw_only=True)
class PauseScore:
    """The opening in pauses; None if there is no pause."""

    count: int
    speed: float | None  # RMS, FAP units per second, at the video's frame rate
    real_speed: float | None
    shut: int  # pauses in which the lips close
    real_shut: int
    shut_after_p50_ms: float | None  # after the last sound
    shut_after_p95_ms: float | None
    real_shut_after_p50_ms: float | None
    real_shut_after_p95_ms: float | None


@dataclass(slots=True, kw_only=True)
class LipScore:
    """One scheme on one group of clips."""

    scheme: str
    delay_ms: float | None  # None: it uses the whole recording
    kind: str  # of the group: all, language, source or speaker
    group: str
    num_clips: int
    curves: dict[str, CurveScore]  # of opening, width and jaw
    closures: HitScore
    closures_in_speech: HitScore
    lip_to_teeth: HitScore
    bpm: int  # phones b p m
    bpm_met: int  # that close
    openings: int  # of the real lips
    openings_met: int  # within 0.3 s
    opening_delay_p50_ms: float | None
    opening_delay_p95_ms: float | None
    pauses: PauseScore


def clips_to_score(
    folder: Path,
    parameters: Path | None,
    *,
    language: str | None = None,
    sources: Collection[str] = (),
) -> list[LipClip]:
    """Read the held-out clips of a folder that the viseme parameters were not trained on.

    Parameters
    ----------
    folder
        Folder of clips.
    parameters
        Viseme parameters. If None, those of the package.
    language, sources
        Only these clips. By default all.

    Raises
    ------
    UserError
        If there are no such clips.
    """
    clips = read_clips(folder, language=language)
    clips = [clip for clip in clips if not sources or clip.source in sources]
    if not clips:
        raise UserError(f"{folder}: no clip is from {', '.join(sources)}; choose other sources")
    clips = [clip for clip in clips if clip.part == "held"]
    if not clips:
        raise UserError(f"{folder}: no clip is held out; list clips or speakers in held.txt")
    seen = clips_seen(parameters)
    clips = [clip for clip in clips if clip.name not in seen]
    if not clips:
        raise UserError(f"{folder}: the parameters were trained on all clips; give others")
    clips = [clip for clip in clips if any(is_measured(clip, name) for name in MEASURES)]
    if not clips:
        raise UserError(
            f"{folder}: no clip measures lip opening (FAP 4 and 5), mouth width (FAP 6 and 7) or "
            "jaw (FAP 3); add such columns"
        )
    return clips


def groups_of(clip: LipClip) -> list[tuple[str, str]]:
    """Return the kinds and names of the groups that a clip belongs to."""
    return [
        ("all", "all"),
        ("language", clip.language),
        ("source", clip.source),
        ("speaker", clip.speaker or "unknown"),
    ]


def pool(scores: Sequence[ClipScore]) -> list[LipScore]:
    """Pool the scores of clips by group and scheme."""
    members: dict[tuple[str, str, str, float | None], list[ClipScore]] = {}
    for kind, name in sorted({group for score in scores for group in groups_of(score.clip)}):
        for score in scores:
            if (kind, name) in groups_of(score.clip):
                members.setdefault((kind, name, score.scheme, score.delay_s), []).append(score)
    return [_pool(*key, group) for key, group in members.items()]


def _pool(
    kind: str, name: str, scheme: str, delay_s: float | None, scores: Sequence[ClipScore]
) -> LipScore:
    curves = {
        measure: reduce(add, (s.curves[measure] for s in scores if measure in s.curves))
        for measure in MEASURES
        if any(measure in score.curves for score in scores)
    }
    events = reduce(add, (score.events for score in scores), EventSums())
    pauses = reduce(add, (score.pauses for score in scores), PauseSums())
    p50, p95 = _percentiles_ms(events.opening_delays_s)
    return LipScore(
        scheme=scheme,
        delay_ms=None if delay_s is None else round(1e3 * delay_s),
        kind=kind,
        group=name,
        num_clips=len(scores),
        curves={measure: _curve_score(sums) for measure, sums in curves.items()},
        closures=_hit_score(events.closures),
        closures_in_speech=_hit_score(events.closures_in_speech),
        lip_to_teeth=_hit_score(events.lip_to_teeth),
        bpm=events.bpm,
        bpm_met=events.bpm_met,
        openings=events.num_openings,
        openings_met=len(events.opening_delays_s),
        opening_delay_p50_ms=p50,
        opening_delay_p95_ms=p95,
        pauses=_pause_score(pauses),
    )


def _curve_score(sums: CurveSums) -> CurveScore:
    best = best_lag(sums.lagged.moments, LAGS_S)
    return CurveScore(
        correlation=sums.everything.correlation,
        correlation_in_speech=sums.in_speech.correlation,
        correlation_without_drift=sums.without_drift.correlation,
        best_lag_ms=None if best is None else round(1e3 * best[1]),
        best_correlation=None if best is None else best[0],
        rmse=sums.everything.rmse,
        turns_per_s=sums.turns.per_second,
        turns_per_s_at_50_hz=sums.turns_at_50_hz.per_second,
        real_turns_per_s=sums.real_turns.per_second,
    )


def _hit_score(events: Detections) -> HitScore:
    return HitScore(
        real=events.num_real,
        met=events.num_met,
        made=events.num_made,
        true=events.num_true,
        recall=events.recall,
        precision=events.precision,
        f1=events.f1,
    )


def _pause_score(sums: PauseSums) -> PauseScore:
    p50, p95 = _percentiles_ms(sums.closed_after_s)
    real_p50, real_p95 = _percentiles_ms(sums.real_closed_after_s)
    return PauseScore(
        count=sums.count,
        speed=sums.speed.rms,
        real_speed=sums.real_speed.rms,
        shut=len(sums.closed_after_s),
        real_shut=len(sums.real_closed_after_s),
        shut_after_p50_ms=p50,
        shut_after_p95_ms=p95,
        real_shut_after_p50_ms=real_p50,
        real_shut_after_p95_ms=real_p95,
    )


def _percentiles_ms(times_s: Sequence[float]) -> tuple[float | None, float | None]:
    if not times_s:
        return None, None
    p50, p95 = 1e3 * np.percentile(times_s, [50, 95])
    return float(p50), float(p95)


def score_lip_models(
    folder: Path, parameters: Path | None = None, sources: Collection[str] = ()
) -> list[LipScore]:
    """Score every lip model on the held-out clips of a folder."""
    model = load_live_model()
    lips = lip_predictor_for(model)
    visemes = DynamicVisemes(load_parameters(parameters), model.inventory)
    models = {name: info.load(model.inventory) for name, info in lip_models().items()}
    schemes = all_schemes(visemes, models | {"dynamic-visemes": visemes})
    scores = []
    clips = clips_to_score(folder, parameters, sources=sources)
    for clip in track(clips, description="clips", transient=True):
        recognized = recognize_clip(model, clip, lips)
        clip_scores = [score_clip(recognized, scheme) for scheme in schemes]
        scores += [score for score in clip_scores if score is not None]
    return pool(scores)
