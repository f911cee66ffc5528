"""The measures of ``kouxing evaluate lips`` by name: functions of the takes of several clips."""

from functools import partial

import numpy as np

from kouxing.evaluation.lips.agreement import Pair, lag_ms, moments
from kouxing.evaluation.lips.closure_measures import (
    CLOSURE_CLASSES,
    class_precision,
    closure_detections,
    labials_shut,
    share_shut,
)
from kouxing.evaluation.lips.effort import effort_correlation, speech_lip_intensity
from kouxing.evaluation.lips.in_speech import correlation_in_speech, turns_per_s
from kouxing.evaluation.lips.mouths import CURVES
from kouxing.evaluation.lips.phone_spread import phone_correlation, phone_spread
from kouxing.evaluation.lips.rest import closing_time_ms, rest_opening
from kouxing.evaluation.lips.take import Measure, Takes


def pairs_of(takes: Takes) -> list[Pair]:
    """Return the predicted and the real mouth of each take."""
    return [(take.predicted, take.real) for take in takes]


def misalignment_ms(takes: Takes) -> float | None:
    """Return the mean temporal misalignment (MTM), mean of the clips, ms."""
    known = [take.misalignment_s for take in takes if take.misalignment_s is not None]
    return 1e3 * float(np.mean(known)) if known else None


MEASURES: dict[str, Measure] = {
    **{f"r_{name}": partial(correlation_in_speech, curve=name) for name in CURVES},
    "r_opening_everywhere": lambda takes: moments(pairs_of(takes), "opening").correlation,
    "error": lambda takes: moments(pairs_of(takes), "opening").rmse,
    "lag_ms": lambda takes: lag_ms(pairs_of(takes)),
    "closure_f1": lambda takes: closure_detections(takes).f1,
    "closure_precision": lambda takes: closure_detections(takes).precision,
    "closure_recall": lambda takes: closure_detections(takes).recall,
    **{f"precision_{name}": partial(class_precision, name=name) for name in CLOSURE_CLASSES},
    "labials_shut": labials_shut,
    "share_shut": share_shut,
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
