"""Measures of effort over clips: whether a mouth moves more when the voice is louder."""

import numpy as np

from kouxing.evaluation.lips.effort import correlate_by_speaker, lip_intensity, opening_range
from kouxing.evaluation.lips.take import Takes


def effort_correlation(takes: Takes) -> float | None:
    """Correlate the range of the opening in speech with the level of the clip, over clips."""
    used = [take for take in takes if len(take.opening_in_speech) > 1]
    return correlate_by_speaker(
        [take.reference.clip.speaker for take in used],
        [20.0 * np.log10(take.reference.rms + 1e-9) for take in used],
        [opening_range(take.opening_in_speech) for take in used],
    )


def speech_lip_intensity(takes: Takes) -> float | None:
    """Return the speech-lip intensity correlation coefficient (SLCC) over clips."""
    used = [take for take in takes if len(take.made.time_s) > 1]
    return correlate_by_speaker(
        [take.reference.clip.speaker for take in used],
        [take.reference.rms for take in used],
        [lip_intensity(take.made) for take in used],
    )
