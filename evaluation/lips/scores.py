"""Score lip models on clips with tracked lips.

The schemes (``schemes.py``) run the same code as the services, on held-out clips. Results are
pooled over all frames of a group of clips: all, a language, a source, a speaker.

- Correlation of opening, width and jaw, after removal of each clip's mean, because a tracked face
  at rest is never exactly at 0. It is measured over everything and in speech only (``is_speech``).
- The lag with the highest correlation, positive if the made lips are late; the error in FAP units.
- Closures: recall, precision and F1 (``measures.py``), also in speech only, because lips that close
  after each word are nearly always right. How many b p m close: the lips must close within 40 ms of
  the phone's quietest moment. The phones come from forced alignment or, without a transcript, from
  offline decoding.
- The time from a real opening to the made one. The face's delay comes on top.

Clips that are out of sync count only for shapes, not for lags and events.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field
from functools import reduce
from itertools import zip_longest
from operator import add
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.evaluation.lips import measures
from kouxing.evaluation.lips.measures import Detections, Moments, Sums
from kouxing.evaluation.lips.schemes import (
    FRAME_RATE_HZ,
    RecognizedClip,
    Scheme,
    all_schemes,
    is_speech,
    labials,
    quietest_moments,
    recognize_clip,
)
from kouxing.services.lip_models import lip_models
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import clips_seen, load_parameters
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

Array = NDArray[np.float64]

MEASURES: dict[str, Callable[[Array], Array]] = {
    "opening": lambda faps: -faps[:, 3] - faps[:, 4],
    "width": lambda faps: faps[:, 5] + faps[:, 6],
    "jaw": lambda faps: faps[:, 2],
}
LAGS_S = np.arange(-30, 31) / 100.0


@dataclass(frozen=True, slots=True)
class Lagged(Sums):
    """Moments at each of ``LAGS_S``; empty for clips that are out of sync."""

    moments: tuple[Moments, ...] = ()

    def __add__(self, other: Lagged) -> Lagged:
        pairs = zip_longest(self.moments, other.moments, fillvalue=Moments())
        return Lagged(tuple(ours + theirs for ours, theirs in pairs))


@dataclass(frozen=True, slots=True)
class CurveSums(Sums):
    """One measure of the mouth."""

    everything: Moments
    in_speech: Moments
    lagged: Lagged


@dataclass(frozen=True, slots=True)
class EventSums(Sums):
    """Closures and openings of the mouth."""

    closures: Detections = field(default_factory=Detections)
    closures_in_speech: Detections = field(default_factory=Detections)
    bpm: int = 0
    bpm_met: int = 0
    num_openings: int = 0
    opening_delays_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ClipScore:
    """Results of one scheme on one clip."""

    clip: LipClip
    scheme: Scheme
    curves: dict[str, CurveSums]  # by measure, if the clip has it
    events: EventSums


def real_faps(clip: LipClip) -> Array:
    """Return the tracked FAPs of a clip, (num_frames, 68), NaN where not measured."""
    faps = np.full((len(clip.time_s), NUM_FAPS), np.nan)
    faps[:, np.array(MOUTH_FAPS) - 1] = clip.faps
    return faps


def is_measured(clip: LipClip, measure: str) -> bool:
    """Whether a clip has any frame of a measure."""
    return not np.isnan(MEASURES[measure](real_faps(clip))).all()


def score_clip(recognized: RecognizedClip, scheme: Scheme) -> ClipScore | None:
    """Score a scheme on a clip; None if the scheme does not apply to the clip.

    If the clip is out of sync, times are not compared: it has no lags and events.
    """
    made = scheme.frames(recognized)
    if made is None:
        return None
    clip, real = recognized.clip, real_faps(recognized.clip)
    in_speech = is_speech(recognized, clip.time_s)
    curves = {
        name: _score_curve(clip, measure(real), measure(made), in_speech)
        for name, measure in MEASURES.items()
        if is_measured(clip, name)
    }
    events = _score_events(recognized, real, made) if clip.is_in_sync else EventSums()
    return ClipScore(clip, scheme, curves, events)


def _score_curve(
    clip: LipClip, real: Array, values: Array, in_speech: NDArray[np.bool_]
) -> CurveSums:
    """Compare a real curve at the clip's times with made values at FRAME_RATE_HZ."""
    is_known = ~np.isnan(real)
    time_s, real, in_speech = clip.time_s[is_known], real[is_known], in_speech[is_known]
    made_s = np.arange(len(values)) / FRAME_RATE_HZ
    made = np.interp(time_s, made_s, values)
    lags_s = LAGS_S if clip.is_in_sync else np.zeros(0)
    lagged = (np.interp(time_s + lag_s, made_s, values) for lag_s in lags_s)
    return CurveSums(
        everything=measures.moments(made, real),
        in_speech=measures.moments(made[in_speech], real[in_speech]),
        lagged=Lagged(tuple(measures.moments(curve, real) for curve in lagged)),
    )


def _score_events(recognized: RecognizedClip, real: Array, made: Array) -> EventSums:
    """Compare closures and openings of real and made FAPs, (num_frames, 68)."""
    clip, time_s = recognized.clip, np.arange(len(made)) / FRAME_RATE_HZ
    real_opening, opening = MEASURES["opening"](real), MEASURES["opening"](made)
    bpm_s = quietest_moments(clip, labials(recognized))
    real_openings_s = measures.openings(clip.time_s, real_opening)
    delays_s = measures.offsets(
        real_openings_s, measures.openings(time_s, opening), measures.OPENING_WINDOW_S
    )
    closures_s = measures.real_closures(clip.time_s, real_opening)
    closed_s = measures.real_closed(clip.time_s, real_opening)
    in_speech = np.where(is_speech(recognized, time_s), opening, measures.HALF_OPEN)
    return EventSums(
        closures=measures.closures(closures_s, closed_s, time_s, opening),
        closures_in_speech=measures.closures(
            closures_s[is_speech(recognized, closures_s)], closed_s, time_s, in_speech
        ),
        bpm=len(bpm_s),
        bpm_met=int(measures.is_closed_at(bpm_s, time_s, opening).sum()),
        num_openings=len(real_openings_s),
        opening_delays_s=tuple(delays_s[~np.isnan(delays_s)]),
    )


@dataclass(slots=True, kw_only=True)
class CurveScore:
    """One measure of the mouth; None if nothing moves or nothing was measured."""

    correlation: float | None
    correlation_in_speech: float | None
    best_lag_ms: float | None  # positive: late
    best_correlation: float | None
    rmse: float | None  # FAP units, clip means removed


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
    bpm: int  # phones b p m
    bpm_met: int  # that close
    openings: int  # of the real lips
    openings_met: int  # within 0.3 s
    opening_delay_p50_ms: float | None
    opening_delay_p95_ms: float | None


def clips_to_score(
    folder: Path,
    parameters: Path | None,
    *,
    language: str | None = None,
    sources: Collection[str] = (),
) -> list[LipClip]:
    """Read the held-out clips of a folder that the viseme parameters were not trained on.

    ``parameters`` of None are those of the package. ``language`` and ``sources`` restrict the
    clips. Raises UserError if none is left.
    """
    seen = clips_seen(parameters)
    filters: dict[str, Callable[[LipClip], bool]] = {
        f"no clip is from {', '.join(sources)}; choose other sources": lambda clip: (
            not sources or clip.source in sources
        ),
        "no clip is held out; list clips or speakers in held.txt": lambda clip: clip.part == "held",
        "the parameters were trained on all clips; use other clips": lambda clip: (
            clip.name not in seen
        ),
        "no clip measures lip opening (FAP 4 and 5), mouth width (FAP 6 and 7) or jaw (FAP 3); "
        "add such columns": lambda clip: any(is_measured(clip, name) for name in MEASURES),
    }
    clips = read_clips(folder, language=language)
    for message, is_kept in filters.items():
        clips = [clip for clip in clips if is_kept(clip)]
        if not clips:
            raise UserError(f"{folder}: {message}")
    return clips


def pool(scores: Sequence[ClipScore]) -> list[LipScore]:
    """Pool the scores of clips by group and scheme."""
    members: dict[tuple[str, str], dict[tuple[str, float | None], list[ClipScore]]] = {}
    for score in scores:
        for group in _groups_of(score.clip).items():
            key = score.scheme.name, score.scheme.delay_s
            members.setdefault(group, {}).setdefault(key, []).append(score)
    return [
        _pool(*group, *key, pooled)
        for group in sorted(members)
        for key, pooled in members[group].items()
    ]


def _groups_of(clip: LipClip) -> dict[str, str]:
    """Return the groups that a clip belongs to, by kind."""
    speaker = clip.speaker or "unknown"
    return {"all": "all", "language": clip.language, "source": clip.source, "speaker": speaker}


def _pool(
    kind: str, name: str, scheme: str, delay_s: float | None, scores: Sequence[ClipScore]
) -> LipScore:
    curves = {
        measure: reduce(add, (s.curves[measure] for s in scores if measure in s.curves))
        for measure in MEASURES
        if any(measure in score.curves for score in scores)
    }
    events = reduce(add, (score.events for score in scores), EventSums())
    p50, p95 = None, None
    if events.opening_delays_s:
        p50, p95 = (1e3 * np.percentile(events.opening_delays_s, [50, 95])).tolist()
    return LipScore(
        scheme=scheme,
        delay_ms=None if delay_s is None else round(1e3 * delay_s),
        kind=kind,
        group=name,
        num_clips=len(scores),
        curves={measure: _curve_score(sums) for measure, sums in curves.items()},
        closures=_hit_score(events.closures),
        closures_in_speech=_hit_score(events.closures_in_speech),
        bpm=events.bpm,
        bpm_met=events.bpm_met,
        openings=events.num_openings,
        openings_met=len(events.opening_delays_s),
        opening_delay_p50_ms=p50,
        opening_delay_p95_ms=p95,
    )


def _curve_score(sums: CurveSums) -> CurveScore:
    best = measures.best_lag(sums.lagged.moments, LAGS_S)
    return CurveScore(
        correlation=sums.everything.correlation,
        correlation_in_speech=sums.in_speech.correlation,
        best_lag_ms=None if best is None else round(1e3 * best[1]),
        best_correlation=None if best is None else best[0],
        rmse=sums.everything.rmse,
    )


def _hit_score(hits: Detections) -> HitScore:
    return HitScore(**asdict(hits), recall=hits.recall, precision=hits.precision, f1=hits.f1)


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
