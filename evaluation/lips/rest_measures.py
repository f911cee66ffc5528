"""Measures of the mouth at rest: its opening in silence, and how soon it closes after speech.

Rigs do not count, because they rest at 0.
"""

from statistics import median

import numpy as np

from kouxing.evaluation.lips.scored_clip import ScoredClips


def rest_opening(clips: ScoredClips) -> float | None:
    """Return the mean opening in silence, FAP units. Rigs do not count: they rest at 0."""
    openings = [
        clip.predicted.at("opening", clip.real.time_s[~clip.in_speech])
        for clip in clips
        if not clip.reference.clip.is_rig
    ]
    together = np.concatenate([np.zeros(0), *openings])
    return float(together.mean()) if len(together) else None


def closing_time_ms(clips: ScoredClips) -> float | None:
    """Return the median time from the last sound before a pause until the lips are closed, ms.

    A pause in which they do not close counts with its whole duration. Rigs do not count.
    """
    times_ms = [
        1e3 * float((closed_s[0] if len(closed_s) else end_s) - start_s)
        for clip in clips
        if not clip.reference.clip.is_rig
        for start_s, end_s in clip.reference.pauses()
        for time_s in [clip.predicted.time_s[clip.predicted.is_closed]]
        for closed_s in [time_s[(time_s >= start_s) & (time_s <= end_s)]]
    ]
    return median(times_ms) if times_ms else None
