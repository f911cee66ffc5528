"""Mouths to compare: tracked mouths, and the mouths of lip models."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kouxing.corpora.lip_clips import CLOSED_FRACTION, LipClip
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.face.expression_motion import CLOSED
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

CURVES: dict[
    str, Callable[[Doubles], Doubles]
] = {  # functions of FAPs (num_frames, 68), in FAP units
    "opening": lambda faps: -faps[:, 3] - faps[:, 4],
    "width": lambda faps: faps[:, 5] + faps[:, 6],
    "jaw": lambda faps: faps[:, 2],
}


@dataclass(frozen=True, slots=True)
class Mouth:
    """The motion of a mouth; frames without an opening are left out."""

    time_s: Doubles  # (num_frames,), ascending
    curves: dict[str, Doubles]  # opening, width and jaw; width and jaw may be NaN
    is_closed: Mask

    @property
    def opening(self) -> Doubles:
        """Distance of the lips, FAP units."""
        return self.curves["opening"]

    def at(self, name: str, time_s: Doubles) -> Doubles:
        """Return a curve at other times."""
        return np.interp(time_s, self.time_s, self.curves[name])


def predicted_mouth(faps: Doubles) -> Mouth:
    """Return the mouth of frames (num_frames, 68) at ``FRAME_RATE_HZ``."""
    curves = {name: curve(faps) for name, curve in CURVES.items()}
    return Mouth(np.arange(len(faps)) / FRAME_RATE_HZ, curves, curves["opening"] < CLOSED)


def real_mouth(time_s: Doubles, faps: Doubles) -> Mouth:
    """Return the mouth of tracked FAPs (num_frames, 68), NaN where not measured.

    Its lips are closed while the opening is in the lowest tenth of its range, because a tracked
    face at rest is never exactly at 0.
    """
    curves = {name: curve(faps) for name, curve in CURVES.items()}
    is_known = ~np.isnan(curves["opening"])
    curves = {name: curve[is_known] for name, curve in curves.items()}
    opening = curves["opening"]
    low, high = np.percentile(opening, [1, 99]) if len(opening) else (0.0, 0.0)
    return Mouth(time_s[is_known], curves, opening < low + CLOSED_FRACTION * (high - low))


def clip_mouth(clip: LipClip) -> Mouth:
    """Return the tracked mouth of a clip."""
    return real_mouth(clip.time_s, real_faps(clip))


def real_faps(clip: LipClip) -> Doubles:
    """Return the tracked FAPs of a clip, (num_frames, 68), NaN where not measured."""
    faps = np.full((len(clip.time_s), NUM_FAPS), np.nan)
    faps[:, np.array(MOUTH_FAPS) - 1] = clip.faps
    return faps
