"""How closely lips from sound follow the lips that made it: figures for the model card.

Correlation of opening, width and jaw, each clip's own means removed, all frames of the clips
pooled. Outside speech there are no lip frames; the mouth counts as at rest there.

Closures: the tracked lips close where their opening has a minimum within the lowest tenth of the
speaker's range and an opening to half of it is near. The sound tells a closure where the
probability is above one half. A real closure is met if one is told within 40 ms; a told closure is
right if the tracked lips touch within 40 ms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.mouth_profiles.lip_tracks import MEASURES, lip_measures, lip_tracks
from kouxing.services.recognizer.lips import CLOSURE
from kouxing.training.lips.targets import Touch, opening

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_TO_REST_S = 0.06  # after the last lip frame
_CLOSURE_WINDOW_S = 0.04
_OPEN_WINDOW_S = 0.2


@dataclass(frozen=True, slots=True)
class Stretch:
    """What the model makes of a stretch of speech."""

    known_s: Array  # (positions,)
    outputs: Floats  # (positions, delays, 17), FAPs in FAP units, then log odds


Made = Mapping[str, Sequence[Stretch]]  # by clip


def correlations(
    clips: Sequence[LipClip], made: Made, delay: int, delay_s: float, *, in_speech: bool = False
) -> Array:
    """Return the correlations of the three measures with one delay; NaN where none is tracked."""
    pairs = [
        _compared(clip, made[clip.name], delay, delay_s, in_speech=in_speech) for clip in clips
    ]
    figures = []
    for measure in range(len(MEASURES)):
        ours, theirs = (np.concatenate([pair[measure][side] for pair in pairs]) for side in (0, 1))
        size = np.sqrt((ours @ ours) * (theirs @ theirs))
        figures.append(float(ours @ theirs / size) if size > 0 else np.nan)
    return np.array(figures)


def _compared(
    clip: LipClip, stretches: Sequence[Stretch], delay: int, delay_s: float, *, in_speech: bool
) -> list[tuple[Array, Array]]:
    """Made and tracked values of each measure at the clip's frames, means removed."""
    spoken = np.zeros(len(clip.time_s), dtype=bool)
    times, values = [np.array([-1.0])], [np.zeros((1, len(MEASURES)))]
    rest = np.zeros((1, len(MEASURES)))
    for stretch in stretches:
        time_s = stretch.known_s - delay_s
        spoken |= (clip.time_s >= time_s[0]) & (clip.time_s <= time_s[-1])
        times += [time_s[:1] - _TO_REST_S, time_s, time_s[-1:] + _TO_REST_S]
        values += [rest, lip_measures(stretch.outputs[:, delay]), rest]
    time_s = np.concatenate(times)
    order = np.argsort(time_s, kind="stable")
    made = np.concatenate(values)[order]
    tracked = lip_measures(lip_tracks(clip.faps))
    pairs = []
    for measure in range(len(MEASURES)):
        known = ~np.isnan(tracked[:, measure]) & (spoken if in_speech else True)
        ours = np.interp(clip.time_s[known], time_s[order], made[:, measure])
        theirs = tracked[known, measure]
        pairs.append((ours - ours.mean(), theirs - theirs.mean()) if len(ours) else (ours, theirs))
    return pairs


@dataclass(slots=True)
class ClosureCounts:
    """Closures of some clips."""

    real: int = 0
    met: int = 0
    told: int = 0
    right: int = 0

    @property
    def recall(self) -> float:
        """Share of the real closures that are told."""
        return self.met / max(self.real, 1)

    @property
    def precision(self) -> float:
        """Share of the told closures that are right."""
        return self.right / max(self.told, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        return 2 * self.recall * self.precision / max(self.recall + self.precision, 1e-9)


def count_closures(
    clips: Sequence[LipClip],
    made: Made,
    touch: Mapping[str, Touch],
    delay: int,
    delay_s: float,
) -> ClosureCounts:
    """Count the closures within speech with one delay."""
    counts = ClosureCounts()
    for clip in clips:
        limits = touch[clip.speaker]
        height = opening(clip)
        known = ~np.isnan(height)
        frame_s, height = clip.time_s[known], height[known]
        touching_s = frame_s[height < limits.closed_below]
        moments_s = _closures(frame_s, height, limits)
        for stretch in made[clip.name]:
            time_s = stretch.known_s - delay_s
            shut = stretch.outputs[:, delay, CLOSURE] > 0
            within = (moments_s >= time_s[0]) & (moments_s <= time_s[-1])
            counts.real += int(within.sum())
            counts.met += sum(_is_near(moment_s, time_s[shut]) for moment_s in moments_s[within])
            for told_s in _runs(time_s, shut):
                if len(frame_s) and frame_s[0] <= told_s[0] and told_s[-1] <= frame_s[-1]:
                    counts.told += 1
                    counts.right += any(_is_near(moment_s, touching_s) for moment_s in told_s)
    return counts


def _closures(frame_s: Array, height: Array, limits: Touch) -> Array:
    """When tracked lips close, seconds."""
    moments = []
    for frame in range(1, len(height) - 1):
        before, here, after = height[frame - 1 : frame + 2]
        if here <= before and here < after and here < limits.closed_below:
            near = np.abs(frame_s - frame_s[frame]) < _OPEN_WINDOW_S
            if height[near].max() > limits.half_open:
                moments.append(frame_s[frame])
    return np.array(moments)


def _runs(time_s: Array, shut: NDArray[np.bool_]) -> list[Array]:
    """Return the times of each run of told positions that does not reach a stretch's end."""
    edges = np.flatnonzero(np.diff(shut)) + 1
    return [time_s[start:end] for start, end in pairwise(edges) if shut[start]]


def _is_near(moment_s: float, times_s: Array) -> bool:
    return bool((np.abs(times_s - moment_s) <= _CLOSURE_WINDOW_S).any())
