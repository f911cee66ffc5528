"""Measures of closures: how many there are, how many are real, and at which phones.

``kouxing.evaluation.lips.closures`` defines a closure.
"""

import numpy as np

from kouxing.evaluation.lips.closures import WINDOW_S, DetectionCounts, is_closed_at
from kouxing.evaluation.lips.references import PAUSE, Reference
from kouxing.evaluation.lips.scored_clip import ScoredClips

# Visemes of the classes in which closures are counted. All other visemes are consonants.
CLOSURE_CLASSES = {
    "bpm": {"b"},
    "aei": {"a", "ai", "ao", "e", "ei", "er", "i"},
    "uo": {"u", "v", "o", "ou"},
    "pause": {PAUSE},
}


def closure_detections(clips: ScoredClips) -> DetectionCounts:
    """Compare the closures of all clips."""
    return sum((clip.closures for clip in clips), DetectionCounts())


def class_precision(clips: ScoredClips, name: str) -> float | None:
    """Return the fraction of the closures at a class of phones at which real lips are closed."""
    hits = [
        contact.is_true
        for clip in clips
        for contact in clip.contacts
        if closure_class(clip.reference, contact.time_s) == name
    ]
    return sum(hits) / len(hits) if hits else None


def closure_class(reference: Reference, time_s: float) -> str:
    """Return the class of the phones at a closure. A b, p or m within 40 ms takes precedence."""
    for phone in reference.labials():
        if phone.onset_s - WINDOW_S <= time_s <= phone.onset_s + phone.duration_s + WINDOW_S:
            return "bpm"
    viseme = reference.viseme_at(time_s)
    return next((name for name, members in CLOSURE_CLASSES.items() if viseme in members), "other")


def labial_closure_rate(clips: ScoredClips) -> float | None:
    """Return the fraction of b p m whose lips are closed within 40 ms of the quietest moment."""
    shut = [
        is_closed_at(clip.reference.quietest_times(clip.reference.labials()), clip.predicted)
        for clip in clips
    ]
    flags = np.concatenate([np.zeros(0, bool), *shut])
    return float(flags.mean()) if len(flags) else None


def closed_fraction(clips: ScoredClips) -> float | None:
    """Return the fraction of the frames in speech in which the lips are closed."""
    flags = [
        clip.predicted.is_closed[clip.reference.is_speech(clip.predicted.time_s)] for clip in clips
    ]
    together = np.concatenate([np.zeros(0, bool), *flags])
    return float(together.mean()) if len(together) else None
