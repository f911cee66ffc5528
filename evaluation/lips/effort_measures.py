"""Whether a mouth moves more when the voice is louder: correlations over clips.

Both figures are normalized for each speaker, because microphones and faces differ.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.lips.mouths import Mouth
from kouxing.evaluation.lips.scored_clip import ScoredClips

Array = NDArray[np.float64]

_MIN_CLIPS = 3  # minimum number of clips per speaker


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


def opening_range(opening: Array) -> float:
    """Return the range of an opening without its extreme twentieths."""
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
