"""Measures of curves during speech: correlation with real lips, and changes of direction.

Pauses are left out, because they raise correlations.
"""

import numpy as np

from kouxing.evaluation.lips.curves import num_turns, pooled_moments
from kouxing.evaluation.lips.scored_clip import ScoredClips


def correlation_in_speech(clips: ScoredClips, curve: str) -> float | None:
    """Return the Pearson correlation of a curve with the real one, after removing clips' means."""
    return pooled_moments(
        (clip.predicted.at(curve, clip.real.time_s)[clip.in_speech], real[clip.in_speech])
        for clip in clips
        for real in [clip.real.curves[curve]]
    ).correlation


def turns_per_s(clips: ScoredClips) -> float | None:
    """Return the number of times per second of speech that the opening changes direction."""
    turns, seconds = 0, 0.0
    for clip in clips:
        opening = clip.opening_in_speech
        turns += num_turns(opening)
        if len(clip.real.time_s) > 1:
            seconds += len(opening) * float(np.median(np.diff(clip.real.time_s)))
    return turns / seconds if seconds else None
