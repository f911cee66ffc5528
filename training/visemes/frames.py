"""The frames of clips, each with the nearest visemes and silences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline, build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST, VISEME_INDEX
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_NEAR = 8  # visemes of a frame that can have weight
_FAR_S = 60.0  # a viseme this far away has no weight


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames of all clips, with the nearest visemes and silences of each."""

    viseme: NDArray[np.intp]  # (num_frames, near)
    before_s: Array  # (num_frames, near) start of the apex minus time
    after_s: Array  # (num_frames, near) its end minus time
    silence_start_s: Array  # (num_frames, 2) minus time
    silence_end_s: Array  # (num_frames, 2) minus time
    faps: Array  # (num_frames, num_mouth_faps)


def frames_of(
    clips: Sequence[LipClip], labels: Sequence[list[Phone]], inventory: PhoneInventory
) -> Frames:
    """Find the nearest visemes and silences of each frame; UserError if no clip contains speech."""
    parts = []
    for clip, phones in zip(clips, labels, strict=True):
        timeline = _padded(build_timeline(phones, inventory))
        if not len(timeline.silence_start_s):
            continue
        time = clip.time_s[:, None]

        def nearest(starts: Array, ends: Array, count: int, time: Array = time) -> NDArray[np.intp]:
            distance = np.maximum(np.maximum(starts - time, time - ends), 0.0)
            return np.argsort(distance, axis=1, kind="stable")[:, :count]

        near = nearest(timeline.apex_start_s, timeline.apex_end_s, _NEAR)
        quiet = nearest(timeline.silence_start_s, timeline.silence_end_s, 2)
        parts.append(
            (
                timeline.viseme[near],
                timeline.apex_start_s[near] - time,
                timeline.apex_end_s[near] - time,
                timeline.silence_start_s[quiet] - time,
                timeline.silence_end_s[quiet] - time,
                clip.faps,
            )
        )
    if not parts:
        raise UserError("the training clips contain no speech; give clips with speech")
    return Frames(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _padded(timeline: Timeline) -> Timeline:
    """Add distant visemes, so that even a short clip has ``_NEAR`` of them."""
    far_s = np.full(max(_NEAR - len(timeline.viseme), 0), np.append(timeline.apex_end_s, 0.0).max())
    far_s += _FAR_S
    return replace(
        timeline,
        viseme=np.append(timeline.viseme, np.full(len(far_s), VISEME_INDEX[REST])),
        apex_start_s=np.append(timeline.apex_start_s, far_s),
        apex_end_s=np.append(timeline.apex_end_s, far_s),
    )
