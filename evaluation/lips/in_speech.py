"""Measures of curves during speech: correlation with real lips, and changes of direction.

Pauses are left out, because they raise correlations.
"""

import numpy as np

from kouxing.evaluation.lips.curves import num_turns, pooled_moments
from kouxing.evaluation.lips.take import Takes


def correlation_in_speech(takes: Takes, curve: str) -> float | None:
    """Return the Pearson correlation of a curve with the real one, after removing clips' means."""
    return pooled_moments(
        (take.predicted.at(curve, take.real.time_s)[take.in_speech], real[take.in_speech])
        for take in takes
        for real in [take.real.curves[curve]]
    ).correlation


def turns_per_s(takes: Takes) -> float | None:
    """Return the number of times per second of speech that the opening changes direction."""
    turns, seconds = 0, 0.0
    for take in takes:
        opening = take.opening_in_speech
        turns += num_turns(opening)
        if len(take.real.time_s) > 1:
            seconds += len(opening) * float(np.median(np.diff(take.real.time_s)))
    return turns / seconds if seconds else None
