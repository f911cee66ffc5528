"""The measures of ``kouxing evaluate lips``: functions of several scored clips.

- Speech: correlation of curves with the real ones, and changes of direction. Pauses are left out,
  because they raise correlations.
- Closures: how many there are, how many are real, and at which phones. ``closures.py`` defines a
  closure.
- Rest: the opening in silence, and how soon the lips close after speech. Rigs do not count, because
  they rest at 0.
- Effort: whether a mouth moves more when the voice is louder. These correlations over clips are
  normalized for each speaker, because microphones and faces differ.
- Spread: the opening within a phone, which varies between repetitions in real speech.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from statistics import median

import numpy as np
from numpy.typing import ArrayLike

from kouxing.evaluation.lips.agreement import lag_ms
from kouxing.evaluation.lips.closures import (
    WINDOW_S,
    Contact,
    DetectionCounts,
    closures,
    contacts,
    is_closed_at,
)
from kouxing.evaluation.lips.curves import num_turns, pooled_moments
from kouxing.evaluation.lips.misalignment import misalignment_s
from kouxing.evaluation.lips.mouths import CURVES, Mouth
from kouxing.evaluation.lips.references import PAUSE, Reference
from kouxing.shared.arrays import Doubles, Mask


@dataclass(frozen=True)
class ScoredClip:
    """A clip and the mouth to evaluate. Figures are cached, because groups of clips overlap."""

    reference: Reference
    predicted: Mouth

    @property
    def real(self) -> Mouth:
        """The clip's real mouth."""
        return self.reference.mouth

    @cached_property
    def in_speech(self) -> Mask:
        """Whether there is speech, at the times of the real frames."""
        return self.reference.is_speech(self.real.time_s)

    @cached_property
    def opening_in_speech(self) -> Doubles:
        """The opening during speech, at the times of the real frames."""
        return self.predicted.at("opening", self.real.time_s)[self.in_speech]

    @cached_property
    def closure_counts(self) -> DetectionCounts:
        """Numbers of real and predicted closures."""
        return closures(self.predicted, self.real)

    @cached_property
    def predicted_closures(self) -> list[Contact]:
        """Predicted closures."""
        return contacts(self.predicted, self.real)

    @cached_property
    def misalignment_s(self) -> float | None:
        """Mean temporal misalignment."""
        return misalignment_s(self.predicted, self.real)


ScoredClips = Sequence[ScoredClip]
Measure = Callable[[ScoredClips], float | None]


_MIN_CLIPS = 3  # minimum number of clips per speaker
# Visemes of the classes in which closures are counted. All other visemes are consonants.
CLOSURE_CLASSES = {
    "bpm": {"b"},
    "aei": {"a", "ai", "ao", "e", "ei", "er", "i"},
    "uo": {"u", "v", "o", "ou"},
    "pause": {PAUSE},
}


def _mean_of_all(values: Iterable[ArrayLike]) -> float | None:
    """Return the mean of joined arrays; None without values."""
    together = np.concatenate([np.zeros(0), *map(np.atleast_1d, values)])
    return float(together.mean()) if len(together) else None


def correlation_in_speech(clips: ScoredClips, curve: str) -> float | None:
    """Return the Pearson correlation of a curve with the real one, after removing clips' means."""
    pairs = []
    for clip in clips:
        predicted, real = clip.predicted.at(curve, clip.real.time_s), clip.real.curves[curve]
        pairs.append((predicted[clip.in_speech], real[clip.in_speech]))
    return pooled_moments(pairs).correlation


def turns_per_s(clips: ScoredClips) -> float | None:
    """Return the number of times per second of speech that the opening changes direction."""
    turns, seconds = 0, 0.0
    for clip in clips:
        opening = clip.opening_in_speech
        turns += num_turns(opening)
        if len(clip.real.time_s) > 1:
            seconds += len(opening) * float(np.median(np.diff(clip.real.time_s)))
    return turns / seconds if seconds else None


def misalignment_ms(clips: ScoredClips) -> float | None:
    """Return the mean temporal misalignment (MTM), mean of the clips, ms."""
    known_s = [clip.misalignment_s for clip in clips if clip.misalignment_s is not None]
    return 1e3 * float(np.mean(known_s)) if known_s else None


def closure_detections(clips: ScoredClips) -> DetectionCounts:
    """Compare the closures of all clips."""
    return sum((clip.closure_counts for clip in clips), DetectionCounts())


def class_precision(clips: ScoredClips, name: str) -> float | None:
    """Return the fraction of the closures at a class of phones at which real lips are closed."""
    return _mean_of_all(
        contact.is_true
        for clip in clips
        for contact in clip.predicted_closures
        if closure_class(clip.reference, contact.time_s) == name
    )


def closure_class(reference: Reference, time_s: float) -> str:
    """Return the class of the phones at a closure. A b, p or m within 40 ms takes precedence."""
    for phone in reference.labials():
        if phone.onset_s - WINDOW_S <= time_s <= phone.end_s + WINDOW_S:
            return "bpm"
    viseme = reference.viseme_at(time_s)
    return next((name for name, members in CLOSURE_CLASSES.items() if viseme in members), "other")


def labial_closure_rate(clips: ScoredClips) -> float | None:
    """Return the fraction of b p m whose lips are closed within 40 ms of the quietest moment."""
    return _mean_of_all(
        is_closed_at(clip.reference.quietest_times(clip.reference.labials()), clip.predicted)
        for clip in clips
    )


def closed_fraction(clips: ScoredClips) -> float | None:
    """Return the fraction of the frames in speech in which the lips are closed."""
    return _mean_of_all(
        clip.predicted.is_closed[clip.reference.is_speech(clip.predicted.time_s)] for clip in clips
    )


def rest_opening(clips: ScoredClips) -> float | None:
    """Return the mean opening in silence, FAP units. Rigs do not count."""
    return _mean_of_all(
        clip.predicted.at("opening", clip.real.time_s[~clip.in_speech])
        for clip in clips
        if not clip.reference.clip.is_rig
    )


def closing_time_ms(clips: ScoredClips) -> float | None:
    """Return the median time from the last sound before a pause until the lips are closed, ms.

    A pause in which they do not close counts with its whole duration. Rigs do not count.
    """
    times_ms = []
    for clip in clips:
        if clip.reference.clip.is_rig:
            continue
        closed_s = clip.predicted.time_s[clip.predicted.is_closed]
        for start_s, end_s in clip.reference.pauses():
            in_pause_s = closed_s[(closed_s >= start_s) & (closed_s <= end_s)]
            first_s = in_pause_s[0] if len(in_pause_s) else end_s
            times_ms.append(1e3 * float(first_s - start_s))
    return median(times_ms) if times_ms else None


def effort_correlation(clips: ScoredClips) -> float | None:
    """Correlate the range of the opening in speech with the level of the clip, over clips."""
    used = [clip for clip in clips if len(clip.opening_in_speech) > 1]
    return correlate_by_speaker(
        [clip.reference.clip.speaker for clip in used],
        [20.0 * np.log10(clip.reference.rms + 1e-9) for clip in used],
        [opening_range(clip.opening_in_speech) for clip in used],
    )


def speech_lip_intensity(clips: ScoredClips) -> float | None:
    """Return the speech-lip intensity correlation coefficient (SLCC) over clips."""
    used = [clip for clip in clips if len(clip.predicted.time_s) > 1]
    return correlate_by_speaker(
        [clip.reference.clip.speaker for clip in used],
        [clip.reference.rms for clip in used],
        [lip_intensity(clip.predicted) for clip in used],
    )


def correlate_by_speaker(
    speakers: Sequence[str], levels: Sequence[float], extents: Sequence[float]
) -> float | None:
    """Correlate the clips' levels with the extents of the mouth's motion.

    Each speaker's values get a mean of 0 and a standard deviation of 1 first. Speakers with fewer
    than three clips are left out. None if no speaker remains.

    >>> round(correlate_by_speaker(["ann"] * 3, [60.0, 66.0, 72.0], [100.0, 300.0, 200.0]), 6)
    0.5
    """
    by_speaker: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for speaker, level, extent in zip(speakers, levels, extents, strict=True):
        by_speaker[speaker].append((level, extent))
    total, num_clips = 0.0, 0
    for values in by_speaker.values():
        clips = np.array(values)
        deviation = clips.std(axis=0)
        if len(clips) >= _MIN_CLIPS and deviation.all():
            total += float(np.prod((clips - clips.mean(axis=0)) / deviation, axis=1).sum())
            num_clips += len(clips)
    return total / num_clips if num_clips else None


def opening_range(opening: Doubles) -> float:
    """Return the range of an opening from its 5th to its 95th percentile."""
    low, high = np.percentile(opening, [5, 95])
    return float(high - low)


def lip_intensity(mouth: Mouth) -> float:
    """Return the lips' intensity for the speech-lip intensity correlation coefficient (SLCC).

    Source: Lee et al., "Perceptually accurate 3D talking head generation", CVPR 2025: the root mean
    square of the lips' displacement between frames. Here it is the opening's, per second. The
    intensity of speech is the root mean square of the samples.

    >>> opening = np.array([0.0, 4.0, 8.0])
    >>> lip_intensity(Mouth(np.arange(3) / 50.0, {"opening": opening}, opening < 20.0))
    200.0
    """
    speed = np.diff(mouth.opening) / np.diff(mouth.time_s)
    return float(np.sqrt(np.mean(speed**2)))


def phone_spread(clips: ScoredClips) -> float | None:
    """Return the standard deviation of the opening within classes of phones, FAP units.

    Only the opening in the middle of each phone counts. The class of a phone is its speaker and its
    viseme. Classes with one phone are left out.
    """
    openings: dict[tuple[str, str], list[float]] = defaultdict(list)
    for clip in clips:
        middles_s = _measured_middles_s(clip)
        at_middles = clip.predicted.at("opening", middles_s)
        for middle_s, opening in zip(middles_s, at_middles, strict=True):
            viseme = clip.reference.viseme_at(middle_s)
            if viseme != PAUSE:
                openings[clip.reference.clip.speaker, viseme].append(opening)
    classes = [np.array(values) for values in openings.values() if len(values) > 1]
    deviations = np.concatenate([np.zeros(0), *(values - values.mean() for values in classes)])
    return float(np.sqrt(np.mean(deviations**2))) if len(deviations) else None


def _measured_middles_s(clip: ScoredClip) -> Doubles:
    """Return the midpoints of the phones during which the real lips were tracked."""
    if not len(clip.real.time_s):
        return np.zeros(0)
    phones = clip.reference.phones
    middles_s: Doubles = np.array([phone.onset_s + 0.5 * phone.duration_s for phone in phones])
    is_measured = (middles_s >= clip.real.time_s[0]) & (middles_s <= clip.real.time_s[-1])
    return np.asarray(middles_s[is_measured])


_COMPARISONS: dict[str, Measure] = {  # with the real lips
    **{f"r_{name}": partial(correlation_in_speech, curve=name) for name in CURVES},
    "lag_ms": lambda clips: lag_ms([(clip.predicted, clip.real) for clip in clips]),
    "closure_f1": lambda clips: closure_detections(clips).f1,
    "closure_precision": lambda clips: closure_detections(clips).precision,
    "closure_recall": lambda clips: closure_detections(clips).recall,
    **{f"precision_{name}": partial(class_precision, name=name) for name in CLOSURE_CLASSES},
    "mtm_ms": misalignment_ms,
}
REAL_MEASURES: dict[str, Measure] = {  # of real lips
    "labials_shut": labial_closure_rate,
    "share_shut": closed_fraction,
    "rest_opening": rest_opening,
    "closing_time_ms": closing_time_ms,
    "effort_correlation": effort_correlation,
    "slcc": speech_lip_intensity,
    "phone_spread": phone_spread,
    "turns_per_s": turns_per_s,
}
MEASURES = _COMPARISONS | REAL_MEASURES  # of predicted lips
