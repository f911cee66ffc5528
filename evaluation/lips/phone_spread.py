"""Measures of the opening within a phone, which varies between repetitions in real speech."""

from collections import defaultdict

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.lips.curves import pooled_moments
from kouxing.evaluation.lips.references import PAUSE
from kouxing.evaluation.lips.scored_clip import ScoredClips

Array = NDArray[np.float64]


def phone_deviations(clips: ScoredClips) -> Array:
    """Return predicted and real openings in the middle of phones, (2, n).

    The mean of each class is subtracted. The class of a phone is its speaker and its viseme.
    Classes with one phone are left out.
    """
    openings: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for clip in clips:
        if not len(clip.real.time_s):
            continue
        for phone in clip.reference.phones:
            middle_s = phone.onset_s + 0.5 * phone.duration_s
            viseme = clip.reference.viseme_at(middle_s)
            if viseme != PAUSE and clip.real.time_s[0] <= middle_s <= clip.real.time_s[-1]:
                pair = [
                    mouth.at("opening", np.array([middle_s]))[0]
                    for mouth in (clip.predicted, clip.real)
                ]
                openings[clip.reference.clip.speaker, viseme].append((pair[0], pair[1]))
    classes = [np.array(pairs).T for pairs in openings.values() if len(pairs) > 1]
    deviations = [pairs - pairs.mean(axis=1, keepdims=True) for pairs in classes]
    return np.concatenate([np.zeros((2, 0)), *deviations], axis=1)


def phone_spread(clips: ScoredClips) -> float | None:
    """Return the standard deviation of the opening within classes of phones, FAP units."""
    deviations = phone_deviations(clips)[0]
    return float(np.sqrt(np.mean(deviations**2))) if len(deviations) else None


def phone_correlation(clips: ScoredClips) -> float | None:
    """Correlate predicted and real openings within classes of phones."""
    predicted, real = phone_deviations(clips)
    return pooled_moments([(predicted, real)]).correlation
