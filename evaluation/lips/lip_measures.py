"""The measures of ``kouxing evaluate lips``: functions of the takes of a group of clips.

A *take* is a clip with a mouth to judge. The mouth is made by a lip model, or it is the clip's real
one, which shows what to aim for. All figures are pooled over the clips.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from statistics import median

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.lips import effort
from kouxing.evaluation.lips.agreement import Pair, lag_ms, moments
from kouxing.evaluation.lips.closures import WINDOW_S, Detections, closures, contacts, is_closed_at
from kouxing.evaluation.lips.curves import num_turns, pooled_moments
from kouxing.evaluation.lips.extrema import misalignment_s
from kouxing.evaluation.lips.mouths import CURVES, Mouth
from kouxing.evaluation.lips.references import PAUSE, Reference

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Visemes of the classes in which closures are counted. All other visemes are consonants.
CLOSURE_CLASSES = {
    "bpm": {"b"},
    "aei": {"a", "ai", "ao", "e", "ei", "er", "i"},
    "uo": {"u", "v", "o", "ou"},
    "pause": {PAUSE},
}


@dataclass(frozen=True)
class Take:
    """A clip and the mouth to judge. Cached figures serve several groups of clips."""

    reference: Reference
    made: Mouth

    @property
    def real(self) -> Mouth:
        """The clip's real mouth."""
        return self.reference.mouth

    @cached_property
    def in_speech(self) -> Mask:
        """Whether somebody speaks, at the times of the real frames."""
        return self.reference.is_speech(self.real.time_s)

    @cached_property
    def opening_in_speech(self) -> Array:
        """The opening while somebody speaks, at the times of the real frames."""
        return self.made.at("opening", self.real.time_s)[self.in_speech]

    @cached_property
    def closures(self) -> Detections:
        """Real and made closures."""
        return closures(self.made, self.real)

    @cached_property
    def contact_classes(self) -> list[tuple[str, bool]]:
        """The class of phones of each made closure, and whether real lips are closed there."""
        return [
            (closure_class(self.reference, contact.time_s), contact.is_true)
            for contact in contacts(self.made, self.real)
        ]

    @cached_property
    def misalignment_s(self) -> float | None:
        """Mean temporal misalignment."""
        return misalignment_s(self.made, self.real)


Takes = Sequence[Take]
Measure = Callable[[Takes], float | None]


def correlation_in_speech(takes: Takes, curve: str) -> float | None:
    """Return the Pearson correlation of a curve with the real one, after removing clips' means."""
    return pooled_moments(
        (take.made.at(curve, take.real.time_s)[take.in_speech], real[take.in_speech])
        for take in takes
        for real in [take.real.curves[curve]]
    ).correlation


def pairs_of(takes: Takes) -> list[Pair]:
    """Return the made and the real mouth of each take."""
    return [(take.made, take.real) for take in takes]


def closure_detections(takes: Takes) -> Detections:
    """Compare the closures of all clips."""
    return sum((take.closures for take in takes), Detections())


def labials_shut(takes: Takes) -> float | None:
    """Return the share of b p m whose lips are closed within 40 ms of the quietest moment."""
    shut = [
        is_closed_at(take.reference.quietest_moments(take.reference.labials()), take.made)
        for take in takes
    ]
    flags = np.concatenate([np.zeros(0, bool), *shut])
    return float(flags.mean()) if len(flags) else None


def share_shut(takes: Takes) -> float | None:
    """Return the share of the frames in speech in which the lips are closed."""
    flags = [take.made.is_closed[take.reference.is_speech(take.made.time_s)] for take in takes]
    together = np.concatenate([np.zeros(0, bool), *flags])
    return float(together.mean()) if len(together) else None


def class_precision(takes: Takes, name: str) -> float | None:
    """Return the share of the closures at a class of phones at which real lips are closed."""
    hits = [is_true for take in takes for kind, is_true in take.contact_classes if kind == name]
    return sum(hits) / len(hits) if hits else None


def closure_class(reference: Reference, time_s: float) -> str:
    """Return the class of the phones at a closure. A b p m within 40 ms comes first."""
    for phone in reference.labials():
        if phone.onset_s - WINDOW_S <= time_s <= phone.onset_s + phone.duration_s + WINDOW_S:
            return "bpm"
    viseme = reference.viseme_at(time_s)
    return next((name for name, members in CLOSURE_CLASSES.items() if viseme in members), "other")


def rest_opening(takes: Takes) -> float | None:
    """Return the mean opening while nobody speaks, FAP units. Rigs do not count: they rest at 0."""
    openings = [
        take.made.at("opening", take.real.time_s[~take.in_speech])
        for take in takes
        if not take.reference.clip.is_rig
    ]
    together = np.concatenate([np.zeros(0), *openings])
    return float(together.mean()) if len(together) else None


def closing_time_ms(takes: Takes) -> float | None:
    """Return the median time from the last sound before a pause until the lips are closed, ms.

    A pause in which they do not close counts with its whole duration. Rigs do not count.
    """
    times_ms = [
        1e3 * float((closed_s[0] if len(closed_s) else end_s) - start_s)
        for take in takes
        if not take.reference.clip.is_rig
        for start_s, end_s in take.reference.pauses()
        for time_s in [take.made.time_s[take.made.is_closed]]
        for closed_s in [time_s[(time_s >= start_s) & (time_s <= end_s)]]
    ]
    return median(times_ms) if times_ms else None


def effort_correlation(takes: Takes) -> float | None:
    """Correlate the range of the opening in speech with the level of the clip, over clips."""
    used = [take for take in takes if len(take.opening_in_speech) > 1]
    return effort.correlate_by_speaker(
        [take.reference.clip.speaker for take in used],
        [20.0 * np.log10(take.reference.rms + 1e-9) for take in used],
        [effort.opening_range(take.opening_in_speech) for take in used],
    )


def speech_lip_intensity(takes: Takes) -> float | None:
    """Return the speech-lip intensity correlation coefficient (SLCC) over clips."""
    used = [take for take in takes if len(take.made.time_s) > 1]
    return effort.correlate_by_speaker(
        [take.reference.clip.speaker for take in used],
        [take.reference.rms for take in used],
        [effort.lip_intensity(take.made) for take in used],
    )


def phone_deviations(takes: Takes) -> Array:
    """Return made and real openings in the middle of phones, (2, n), less their classes' means.

    The class of a phone is its speaker and its viseme. Classes with one phone are left out.
    """
    openings: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for take in takes:
        if not len(take.real.time_s):
            continue
        for phone in take.reference.phones:
            middle_s = phone.onset_s + 0.5 * phone.duration_s
            viseme = take.reference.viseme_at(middle_s)
            if viseme != PAUSE and take.real.time_s[0] <= middle_s <= take.real.time_s[-1]:
                pair = [
                    mouth.at("opening", np.array([middle_s]))[0] for mouth in (take.made, take.real)
                ]
                openings[take.reference.clip.speaker, viseme].append((pair[0], pair[1]))
    classes = [np.array(pairs).T for pairs in openings.values() if len(pairs) > 1]
    deviations = [pairs - pairs.mean(axis=1, keepdims=True) for pairs in classes]
    return np.concatenate([np.zeros((2, 0)), *deviations], axis=1)


def phone_spread(takes: Takes) -> float | None:
    """Return the standard deviation of the opening within classes of phones, FAP units."""
    deviations = phone_deviations(takes)[0]
    return float(np.sqrt(np.mean(deviations**2))) if len(deviations) else None


def phone_correlation(takes: Takes) -> float | None:
    """Correlate made and real openings within classes of phones."""
    made, real = phone_deviations(takes)
    return pooled_moments([(made, real)]).correlation


def turns_per_s(takes: Takes) -> float | None:
    """Return how often the opening changes its direction, per second of speech."""
    turns, seconds = 0, 0.0
    for take in takes:
        opening = take.opening_in_speech
        turns += num_turns(opening)
        if len(take.real.time_s) > 1:
            seconds += len(opening) * float(np.median(np.diff(take.real.time_s)))
    return turns / seconds if seconds else None


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
