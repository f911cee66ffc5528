"""What one scheme reaches on one clip: sums that are pooled over clips (``scores.py``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.measures import (
    NEITHER_SHUT_NOR_OPEN,
    PAIRING_WINDOW_S,
    Hits,
    Likeness,
    Speed,
    Turns,
    closures,
    likeness,
    lip_to_teeth,
    lip_to_teeth_poses,
    made_shut,
    offsets,
    openings,
    real_closures,
    real_shut,
    shut_after,
    shut_at,
    speed_in,
    turns,
    without_drift,
)
from kouxing.evaluation.lips.schemes import (
    FRAME_RATE_HZ,
    HeardClip,
    Scheme,
    is_speech,
    pauses,
    phones_shaped,
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
_PHONE_WINDOW_S = 0.1  # around the middle of an f


@dataclass(frozen=True, slots=True)
class CurveSums:
    """One measure of the mouth."""

    everything: Likeness
    in_speech: Likeness
    no_drift: Likeness
    lagged: tuple[Likeness, ...]  # at LAGS_S; none where times do not count
    turns: Turns
    turns_at_50_hz: Turns
    real_turns: Turns

    def __add__(self, other: CurveSums) -> CurveSums:
        return CurveSums(
            self.everything + other.everything,
            self.in_speech + other.in_speech,
            self.no_drift + other.no_drift,
            tuple(a + b for a, b in zip_longest(self.lagged, other.lagged, fillvalue=Likeness())),
            self.turns + other.turns,
            self.turns_at_50_hz + other.turns_at_50_hz,
            self.real_turns + other.real_turns,
        )


@dataclass(frozen=True, slots=True)
class EventSums:
    """Closures and openings of the mouth."""

    closures: Hits = field(default_factory=Hits)
    closures_in_speech: Hits = field(default_factory=Hits)
    lip_to_teeth: Hits = field(default_factory=Hits)
    bpm: int = 0
    bpm_met: int = 0
    num_openings: int = 0
    opening_delays_s: tuple[float, ...] = ()

    def __add__(self, other: EventSums) -> EventSums:
        return EventSums(
            self.closures + other.closures,
            self.closures_in_speech + other.closures_in_speech,
            self.lip_to_teeth + other.lip_to_teeth,
            self.bpm + other.bpm,
            self.bpm_met + other.bpm_met,
            self.num_openings + other.num_openings,
            self.opening_delays_s + other.opening_delays_s,
        )


@dataclass(frozen=True, slots=True)
class PauseSums:
    """The opening while nobody speaks."""

    count: int = 0
    speed: Speed = field(default_factory=Speed)
    real_speed: Speed = field(default_factory=Speed)
    shut_after_s: tuple[float, ...] = ()  # of the pauses in which the lips shut
    real_shut_after_s: tuple[float, ...] = ()

    def __add__(self, other: PauseSums) -> PauseSums:
        return PauseSums(
            self.count + other.count,
            self.speed + other.speed,
            self.real_speed + other.real_speed,
            self.shut_after_s + other.shut_after_s,
            self.real_shut_after_s + other.real_shut_after_s,
        )


@dataclass(frozen=True, slots=True)
class ClipScore:
    """What one scheme reaches on one clip."""

    clip: LipClip
    scheme: str
    delay_s: float | None
    curves: dict[str, CurveSums]  # of the measures that the clip has
    events: EventSums
    pauses: PauseSums


def real_faps(clip: LipClip) -> Array:
    """Tracked FAPs of a clip, (num_frames, 68), nan where not measured."""
    faps = np.full((len(clip.time_s), NUM_FAPS), np.nan)
    faps[:, np.array(MOUTH_FAPS) - 1] = clip.faps
    return faps


def is_measured(clip: LipClip, measure: str) -> bool:
    """Whether a clip has any frame of a measure."""
    return not np.isnan(MEASURES[measure](real_faps(clip))).all()


def score_clip(heard: HeardClip, scheme: Scheme) -> ClipScore | None:
    """Score what a scheme makes of a clip; None if it makes nothing of it.

    A clip whose sound is not in sync with the picture has no lags, events and pauses.
    """
    made = scheme.frames(heard)
    if made is None:
        return None
    clip, real = heard.clip, real_faps(heard.clip)
    in_speech = is_speech(heard, clip.time_s)
    curves = {
        name: _score_curve(clip, measure(real), measure(made), in_speech)
        for name, measure in MEASURES.items()
        if is_measured(clip, name)
    }
    events = _score_events(heard, real, made) if clip.is_in_sync else EventSums()
    silence = _score_pauses(heard, real, made) if clip.is_in_sync else PauseSums()
    return ClipScore(clip, scheme.name, scheme.delay_s, curves, events, silence)


def _score_curve(
    clip: LipClip, real: Array, values: Array, in_speech: NDArray[np.bool_]
) -> CurveSums:
    """Compare a real curve at the clip's times with made values at the synthesizer's."""
    known = ~np.isnan(real)
    time_s, real, in_speech = clip.time_s[known], real[known], in_speech[known]
    made_s = np.arange(len(values)) / FRAME_RATE_HZ
    made = np.interp(time_s, made_s, values)
    lags_s = LAGS_S if clip.is_in_sync else np.zeros(0)
    rate_hz = 1.0 / float(np.median(np.diff(clip.time_s)))
    return CurveSums(
        everything=likeness(made, real),
        in_speech=likeness(made[in_speech], real[in_speech]),
        no_drift=likeness(without_drift(made, rate_hz), without_drift(real, rate_hz)),
        lagged=tuple(likeness(np.interp(time_s + lag_s, made_s, values), real) for lag_s in lags_s),
        turns=turns(time_s, made),
        turns_at_50_hz=turns(made_s, values),
        real_turns=turns(time_s, real),
    )


def _score_events(heard: HeardClip, real: Array, made: Array) -> EventSums:
    """Compare closures and openings of real FAPs with those of made ones, (num_frames, 68)."""
    clip = heard.clip
    bpm_s = quietest_moments(clip, phones_shaped(heard, "b"))
    f_s = np.array([phone.onset_s + phone.duration_s / 2.0 for phone in phones_shaped(heard, "f")])
    poses_s = lip_to_teeth_poses(clip.time_s, real[:, 3], real[:, 4])
    real_f_s = f_s + offsets(f_s, poses_s, _PHONE_WINDOW_S)
    real_f_s = real_f_s[~np.isnan(real_f_s)]
    real_opening, opening = MEASURES["opening"](real), MEASURES["opening"](made)
    real_openings_s = openings(clip.time_s, real_opening)
    time_s = np.arange(len(made)) / FRAME_RATE_HZ
    delays_s = offsets(real_openings_s, openings(time_s, opening), PAIRING_WINDOW_S)
    closures_s = real_closures(clip.time_s, real_opening)
    shut_s = real_shut(clip.time_s, real_opening)
    spoken = np.where(is_speech(heard, time_s), opening, NEITHER_SHUT_NOR_OPEN)
    return EventSums(
        closures=closures(closures_s, shut_s, time_s, opening),
        closures_in_speech=closures(
            closures_s[is_speech(heard, closures_s)], shut_s, time_s, spoken
        ),
        lip_to_teeth=lip_to_teeth(real_f_s, poses_s, time_s, made[:, 3], made[:, 4]),
        bpm=len(bpm_s),
        bpm_met=int(shut_at(bpm_s, time_s, opening).sum()),
        num_openings=len(real_openings_s),
        opening_delays_s=_known(delays_s),
    )


def _score_pauses(heard: HeardClip, real: Array, made: Array) -> PauseSums:
    """Compare the openings of real FAPs in pauses with those of made ones, (num_frames, 68)."""
    real_s, made_s = heard.clip.time_s, np.arange(len(made)) / FRAME_RATE_HZ
    real_opening, opening = MEASURES["opening"](real), MEASURES["opening"](made)
    pauses_s = pauses(heard)
    return PauseSums(
        count=len(pauses_s),
        speed=speed_in(pauses_s, real_s, np.interp(real_s, made_s, opening)),
        real_speed=speed_in(pauses_s, real_s, real_opening),
        shut_after_s=_known(shut_after(pauses_s, made_shut(made_s, opening))),
        real_shut_after_s=_known(shut_after(pauses_s, real_shut(real_s, real_opening))),
    )


def _known(values: Array) -> tuple[float, ...]:
    return tuple(values[~np.isnan(values)])
