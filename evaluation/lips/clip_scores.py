"""Compare the lips of one scheme with the tracked lips of one clip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips import measures
from kouxing.evaluation.lips.measures import Detections, Moments, Speed, Sums, Turns
from kouxing.evaluation.lips.schemes import (
    FRAME_RATE_HZ,
    RecognizedClip,
    Scheme,
    is_speech,
    pauses,
    phones_with_viseme,
    quietest_moments,
)
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

Array = NDArray[np.float64]

MEASURES: dict[str, Callable[[Array], Array]] = {
    "opening": lambda faps: -faps[:, 3] - faps[:, 4],
    "width": lambda faps: faps[:, 5] + faps[:, 6],
    "jaw": lambda faps: faps[:, 2],
}
LAGS_S = np.arange(-30, 31) / 100.0
_F_WINDOW_S = 0.1  # around the middle of an f


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
    without_drift: Moments
    lagged: Lagged
    turns: Turns
    turns_at_50_hz: Turns
    real_turns: Turns


@dataclass(frozen=True, slots=True)
class EventSums(Sums):
    """Closures and openings of the mouth."""

    closures: Detections = field(default_factory=Detections)
    closures_in_speech: Detections = field(default_factory=Detections)
    lip_to_teeth: Detections = field(default_factory=Detections)
    bpm: int = 0
    bpm_met: int = 0
    num_openings: int = 0
    opening_delays_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class PauseSums(Sums):
    """The mouth in pauses."""

    count: int = 0
    speed: Speed = field(default_factory=Speed)
    real_speed: Speed = field(default_factory=Speed)
    closed_after_s: tuple[float, ...] = ()  # for pauses in which the lips close
    real_closed_after_s: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ClipScore:
    """Results of one scheme on one clip."""

    clip: LipClip
    scheme: str
    delay_s: float | None
    curves: dict[str, CurveSums]  # by measure, if the clip has it
    events: EventSums
    pauses: PauseSums


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

    If the clip is out of sync, times are not compared: it has no lags, events and pauses.
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
    in_pauses = _score_pauses(recognized, real, made) if clip.is_in_sync else PauseSums()
    return ClipScore(clip, scheme.name, scheme.delay_s, curves, events, in_pauses)


def _score_curve(
    clip: LipClip, real: Array, values: Array, in_speech: NDArray[np.bool_]
) -> CurveSums:
    """Compare a real curve at the clip's times with made values at FRAME_RATE_HZ."""
    is_known = ~np.isnan(real)
    time_s, real, in_speech = clip.time_s[is_known], real[is_known], in_speech[is_known]
    made_s = np.arange(len(values)) / FRAME_RATE_HZ
    made = np.interp(time_s, made_s, values)
    rate_hz = 1.0 / float(np.median(np.diff(clip.time_s)))
    lags_s = LAGS_S if clip.is_in_sync else np.zeros(0)
    lagged = (np.interp(time_s + lag_s, made_s, values) for lag_s in lags_s)
    return CurveSums(
        everything=measures.moments(made, real),
        in_speech=measures.moments(made[in_speech], real[in_speech]),
        without_drift=measures.moments(
            measures.without_drift(made, rate_hz), measures.without_drift(real, rate_hz)
        ),
        lagged=Lagged(tuple(measures.moments(curve, real) for curve in lagged)),
        turns=measures.turns(time_s, made),
        turns_at_50_hz=measures.turns(made_s, values),
        real_turns=measures.turns(time_s, real),
    )


def _score_events(recognized: RecognizedClip, real: Array, made: Array) -> EventSums:
    """Compare closures and openings of real and made FAPs, (num_frames, 68)."""
    clip, time_s = recognized.clip, np.arange(len(made)) / FRAME_RATE_HZ
    real_opening, opening = MEASURES["opening"](real), MEASURES["opening"](made)
    bpm_s = quietest_moments(clip, phones_with_viseme(recognized, "b"))
    f_s = np.array(
        [phone.onset_s + phone.duration_s / 2.0 for phone in phones_with_viseme(recognized, "f")]
    )
    poses_s = measures.lip_to_teeth_poses(clip.time_s, real[:, 3], real[:, 4])
    real_f_s = f_s + measures.offsets(f_s, poses_s, _F_WINDOW_S)
    real_f_s = real_f_s[~np.isnan(real_f_s)]
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
        lip_to_teeth=measures.lip_to_teeth(real_f_s, poses_s, time_s, made[:, 3], made[:, 4]),
        bpm=len(bpm_s),
        bpm_met=int(measures.is_closed_at(bpm_s, time_s, opening).sum()),
        num_openings=len(real_openings_s),
        opening_delays_s=_known(delays_s),
    )


def _score_pauses(recognized: RecognizedClip, real: Array, made: Array) -> PauseSums:
    """Compare the openings of real and made FAPs, (num_frames, 68), in pauses."""
    real_s, made_s = recognized.clip.time_s, np.arange(len(made)) / FRAME_RATE_HZ
    real_opening, opening = MEASURES["opening"](real), MEASURES["opening"](made)
    pauses_s = pauses(recognized)
    made_closed_s = measures.made_closed(made_s, opening)
    real_closed_s = measures.real_closed(real_s, real_opening)
    return PauseSums(
        count=len(pauses_s),
        speed=measures.speed_in(pauses_s, real_s, np.interp(real_s, made_s, opening)),
        real_speed=measures.speed_in(pauses_s, real_s, real_opening),
        closed_after_s=_known(measures.closed_after(pauses_s, made_closed_s)),
        real_closed_after_s=_known(measures.closed_after(pauses_s, real_closed_s)),
    )


def _known(values: Array) -> tuple[float, ...]:
    return tuple(values[~np.isnan(values)])
