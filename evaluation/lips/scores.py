"""How well synthesized lips move like real ones.

The schemes (``schemes.py``) run the same chain as the product, end of speech included, on clips
with tracked lips. Each figure is pooled over the frames of a group of clips: all, a language, a
source, a speaker.

- Correlation of opening (inner lips), width and jaw, each clip's own means removed, since a
  tracked face at rest is never quite at 0: over everything; within speech only (voice activity and
  level, ``is_speech``); over everything with drift under 1 Hz removed from both.
- The lag at which correlation is best, above 0 where the synthesized lips are late; error in FAP
  units.
- Closures: recall, precision and F1 (``measures.py``), and within speech only: lips that shut at
  the end of each word are nearly always right to. Lower lip to upper teeth: recall of the f
  that the tracks show, precision of what looks like it. How many b p m close: the synthesized lips
  meet within 40 ms of the phone's quietest moment. The phones f b p m, only of clips in the
  recognizer's language, are those of the aligned text or, where that is unknown, of offline
  decoding, which the scheme of recognised phones then meets by construction.
- Turns: sign changes of the velocity a second, and those of the real lips, both at the frame rate
  of the video; those at 50 Hz besides, since 25 images a second do not show all flicker. Tracked
  lips tremble by errors of tracking: smooth ones (an animator's rig) are the stricter measure.
- The time from a real opening to the synthesized one, in media time: a viewer waits for the delay
  besides.
- Pauses, half a second and more without speech (``schemes.pauses``): root mean square of the
  opening's velocity at the video's frame rate, once the lips had 0.3 s to close, and that of the
  real lips, whose tracking trembles; a mouth at rest has 0. The time from the last sound to lips
  that are shut, synthesized and real, in media time, and in how many pauses they shut at all.

Clips whose sound is not in sync with the picture count for no time: not for lags, closures,
openings and pauses. The real lips of another speaker who says the same, a bound of what sound can
tell, would need clips that share a sentence.

Only clips that are held out are scored, and of them only those that the parameters have not seen.
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
from kouxing.evaluation.lips.measures import Hits, best_lag
from kouxing.evaluation.lips.schemes import all_schemes, hear
from kouxing.services.lip_models import lip_models
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import clips_seen, load_parameters
from kouxing.shared.errors import UserError


@dataclass(slots=True, kw_only=True)
class CurveScore:
    """One measure of the mouth; None where nothing moves or nothing was measured."""

    correlation: float | None
    correlation_in_speech: float | None
    correlation_without_drift: float | None
    best_lag_ms: float | None  # above 0: late
    best_correlation: float | None
    rmse: float | None  # FAP units, own means removed
    turns_per_s: float | None  # at the video's frame rate, as the real lips'
    turns_per_s_at_50_hz: float | None  # what a face shows
    real_turns_per_s: float | None


@dataclass(slots=True, kw_only=True)
class HitScore:
    """Real events that are met, and made ones that are true."""

    real: int
    met: int
    made: int
    true: int
    recall: float | None
    precision: float | None
    f1: float | None


@dataclass(slots=True, kw_only=True)
class PauseScore:
    """The opening while nobody speaks; None where there is no pause."""

    count: int
    speed: float | None  # root mean square, FAP units a second, at the video's frame rate
    real_speed: float | None
    shut: int  # pauses in which the lips shut
    real_shut: int
    shut_after_p50_ms: float | None  # from the last sound
    shut_after_p95_ms: float | None
    real_shut_after_p50_ms: float | None
    real_shut_after_p95_ms: float | None


@dataclass(slots=True, kw_only=True)
class LipScore:
    """One scheme on one group of clips."""

    scheme: str
    delay_ms: float | None  # None: it knows the whole recording
    kind: str  # of the group: "all", "language", "source" or "speaker"
    group: str
    num_clips: int
    curves: dict[str, CurveScore]  # of opening, width, jaw, where measured
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
    """Held-out clips of a folder that some viseme parameters have not seen either.

    Parameters
    ----------
    folder
        Of clips.
    parameters
        Viseme parameters; None: those shipped.
    language, sources
        Only these clips; by default all.

    Raises
    ------
    UserError
        There are none.
    """
    clips = [
        clip
        for clip in read_clips(folder, language=language)
        if not sources or clip.source in sources
    ]
    if not clips:
        raise UserError(f"{folder}: no clip is from {', '.join(sources)}; give other sources")
    held = [clip for clip in clips if clip.part == "held"]
    if not held:
        raise UserError(f"{folder}: no clip is held out; name clips or speakers in held.txt")
    seen = clips_seen(parameters)
    unseen = [clip for clip in held if clip.name not in seen]
    if not unseen:
        raise UserError(
            f"{folder}: the parameters were learnt from or chosen with every held clip; give other "
            "clips"
        )
    measured = [clip for clip in unseen if any(is_measured(clip, name) for name in MEASURES)]
    if not measured:
        raise UserError(
            f"{folder}: no clip measures lip opening (FAP 4 and 5), mouth width (FAP 6 and 7) or "
            "jaw (FAP 3); add such columns"
        )
    return measured


def groups_of(clip: LipClip) -> list[tuple[str, str]]:
    """Kinds and names of the groups that a clip counts in."""
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
    return [
        _pooled(kind, name, scheme, delay_s, group)
        for (kind, name, scheme, delay_s), group in members.items()
    ]


def _pooled(
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
    best = best_lag(sums.lagged, LAGS_S)
    return CurveScore(
        correlation=sums.everything.correlation,
        correlation_in_speech=sums.in_speech.correlation,
        correlation_without_drift=sums.no_drift.correlation,
        best_lag_ms=None if best is None else round(1e3 * best[1]),
        best_correlation=None if best is None else best[0],
        rmse=sums.everything.rmse,
        turns_per_s=sums.turns.per_second,
        turns_per_s_at_50_hz=sums.turns_at_50_hz.per_second,
        real_turns_per_s=sums.real_turns.per_second,
    )


def _hit_score(hits: Hits) -> HitScore:
    return HitScore(
        real=hits.num_real,
        met=hits.num_met,
        made=hits.num_made,
        true=hits.num_true,
        recall=hits.recall,
        precision=hits.precision,
        f1=hits.f1,
    )


def _pause_score(sums: PauseSums) -> PauseScore:
    p50, p95 = _percentiles_ms(sums.shut_after_s)
    real_p50, real_p95 = _percentiles_ms(sums.real_shut_after_s)
    return PauseScore(
        count=sums.count,
        speed=sums.speed.rms,
        real_speed=sums.real_speed.rms,
        shut=len(sums.shut_after_s),
        real_shut=len(sums.real_shut_after_s),
        shut_after_p50_ms=p50,
        shut_after_p95_ms=p95,
        real_shut_after_p50_ms=real_p50,
        real_shut_after_p95_ms=real_p95,
    )


def _percentiles_ms(times_s: Sequence[float]) -> tuple[float | None, float | None]:
    """Return the median and the 95th percentile, ms; None without times."""
    if not times_s:
        return None, None
    p50, p95 = 1e3 * np.percentile(times_s, [50, 95])
    return float(p50), float(p95)


def main(
    folder: Path, parameters: Path | None = None, sources: Collection[str] = ()
) -> list[LipScore]:
    """Score every lip model on the held clips of a folder."""
    model = load_live_model()
    lips = lip_predictor_for(model)
    visemes = DynamicVisemes(load_parameters(parameters), model.inventory)
    models = {name: make(model.inventory) for name, make in lip_models().items()}
    schemes = all_schemes(visemes, models | {"dynamic-visemes": visemes})
    clips = clips_to_score(folder, parameters, sources=sources)
    scores = []
    for clip in track(clips, description="clips", transient=True):
        heard = hear(model, clip, lips)
        found = [score_clip(heard, scheme) for scheme in schemes]
        scores += [score for score in found if score is not None]
    return pool(scores)
