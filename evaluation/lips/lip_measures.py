"""The measures of ``kouxing evaluate lips`` by name: functions of several scored clips."""

from functools import partial

import numpy as np

from kouxing.evaluation.lips.agreement import MouthPair, lag_ms, moments
from kouxing.evaluation.lips.closure_measures import (
    CLOSURE_CLASSES,
    class_precision,
    closed_fraction,
    closure_detections,
    labial_closure_rate,
)
from kouxing.evaluation.lips.effort_measures import effort_correlation, speech_lip_intensity
from kouxing.evaluation.lips.mouths import CURVES
from kouxing.evaluation.lips.phone_spread import phone_correlation, phone_spread
from kouxing.evaluation.lips.rest_measures import closing_time_ms, rest_opening
from kouxing.evaluation.lips.scored_clip import Measure, ScoredClips
from kouxing.evaluation.lips.speech_measures import correlation_in_speech, turns_per_s


def pairs_of(clips: ScoredClips) -> list[MouthPair]:
    """Return the predicted and the real mouth of each clip."""
    return [(clip.predicted, clip.real) for clip in clips]


def misalignment_ms(clips: ScoredClips) -> float | None:
    """Return the mean temporal misalignment (MTM), mean of the clips, ms."""
    known = [clip.misalignment_s for clip in clips if clip.misalignment_s is not None]
    return 1e3 * float(np.mean(known)) if known else None


MEASURES: dict[str, Measure] = {
    **{f"r_{name}": partial(correlation_in_speech, curve=name) for name in CURVES},
    "r_opening_everywhere": lambda clips: moments(pairs_of(clips), "opening").correlation,
    "error": lambda clips: moments(pairs_of(clips), "opening").rmse,
    "lag_ms": lambda clips: lag_ms(pairs_of(clips)),
    "closure_f1": lambda clips: closure_detections(clips).f1,
    "closure_precision": lambda clips: closure_detections(clips).precision,
    "closure_recall": lambda clips: closure_detections(clips).recall,
    **{f"precision_{name}": partial(class_precision, name=name) for name in CLOSURE_CLASSES},
    "labials_shut": labial_closure_rate,
    "share_shut": closed_fraction,
    "rest_opening": rest_opening,
    "closing_time_ms": closing_time_ms,
    "effort_correlation": effort_correlation,
    "slcc": speech_lip_intensity,
    "phone_spread": phone_spread,
    "phone_correlation": phone_correlation,
    "turns_per_s": turns_per_s,
    "mtm_ms": misalignment_ms,
}
COMPARISONS = {  # measures that compare with the real lips, so the real lips have none
    "r_opening", "r_width", "r_jaw", "r_opening_everywhere", "error", "lag_ms", "closure_f1",
    "closure_precision", "closure_recall", *(f"precision_{name}" for name in CLOSURE_CLASSES),
    "phone_correlation", "mtm_ms",
}  # fmt: skip
