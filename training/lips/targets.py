"""Targets of the lip model: a clip's lips at the network's positions, for every delay.

======== ============================================================== ==========
symbol   meaning                                                        unit
======== ============================================================== ==========
T        media time up to which the audio is known at a position        s
d        delay: a position's target is the mouth at T - d               s
======== ============================================================== ==========

Left and right are averaged, because the audio does not contain which side a speaker favors. Lips
touch where the tracked opening is within the lowest tenth of its speaker's range. The lower lip
touches the teeth within each phone f, aligned with the clip's text or recognized. Other languages
have no such label.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from kouxing.corpora.lip_clips import CLOSED_FRACTION, LipClip, opening_of
from kouxing.services.mouth_profiles.lip_tracks import interpolate_track, select_lip_faps
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.phones.events import Phone

_RANGE_PERCENTILES = (1.0, 99.0)
_LIP_TO_TEETH = "f"


def closed_below(clips: Sequence[LipClip]) -> dict[str, float]:
    """Measure the opening, FAP units, below which the lips of each speaker touch."""
    by_speaker: dict[str, list[Doubles]] = defaultdict(list)
    for clip in clips:
        by_speaker[clip.speaker].append(opening_of(clip.faps))
    limits = {}
    for speaker, heights in by_speaker.items():
        known = np.concatenate(heights)
        known = known[~np.isnan(known)]
        low, high = np.percentile(known, _RANGE_PERCENTILES) if len(known) else (np.nan, np.nan)
        limits[speaker] = float(low + CLOSED_FRACTION * (high - low))
    return limits


def targets_at(
    clip: LipClip,
    phones: Sequence[Phone] | None,
    closed_at: float,
    known_s: Doubles,
    delays_s: Sequence[float],
) -> Floats:
    """Compute the targets of positions whose audio is known up to ``known_s``, (n,), in the clip.

    ``phones`` are None if the recognizer does not support the clip's language. Below the opening
    ``closed_at`` the speaker's lips touch. Returns FAPs in FAP units, closure and lip to teeth (0
    or 1), (n, delays, 17); NaN if unknown.
    """
    time_s = known_s[:, None] - np.asarray(delays_s)
    faps = [interpolate_track(clip.time_s, track, time_s) for track in select_lip_faps(clip.faps).T]
    height = interpolate_track(clip.time_s, opening_of(clip.faps), time_s)
    closure = np.where(np.isnan(height), np.nan, height < closed_at)
    lip_to_teeth = np.full(time_s.shape, np.nan if phones is None else 0.0)
    for phone in phones or ():
        if phone.symbol == _LIP_TO_TEETH:
            end_s = phone.end_s
            lip_to_teeth[(time_s >= phone.onset_s) & (time_s < end_s)] = 1.0
    return np.stack([*faps, closure, lip_to_teeth], axis=-1).astype(np.float32)
