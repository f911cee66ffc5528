"""The model of dynamic visemes, offline: converts timed phones to all FAP frames.

Source: Wang & Cai 2003, eq. 6: every frame blends all visemes and silences. Li et al. 2011, 3.2,
schemes 1 (phones of a forced alignment) and 2 (recognized phones with their times).
"""

from collections.abc import Sequence

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.model import (
    DynamicVisemes,
    VisemeArticulation,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.modifiers.amplitude import AmplitudeModifier
from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone

_BLOCK_S = 2.0
_REACH_S = 1.5  # visemes further away have no visible weight


def synthesize(
    lips: DynamicVisemes,
    phones: Sequence[Phone],
    num_frames: int,
    frame_rate_hz: float = 50.0,
    levels: Sequence[tuple[float, float]] = (),
) -> Floats:
    """Return the FAP frames (num_frames, 68) of an utterance.

    The phones have their true times; gaps and silences are pauses. ``levels`` has times in seconds
    and levels in dB of full scale, if known.
    """
    parameters = lips.parameters
    timeline = build_timeline(phones, lips.inventory)
    time_s = np.arange(num_frames) / frame_rate_hz
    faps = np.zeros((num_frames, NUM_FAPS), dtype=np.float32)
    block = max(int(_BLOCK_S * frame_rate_hz), 1)
    for first in range(0, num_frames, block):
        times = time_s[first : first + block]
        start_s, end_s = times[0] - _REACH_S, times[-1] + _REACH_S
        near = timeline.select((timeline.apex_end_s >= start_s) & (timeline.apex_start_s <= end_s))
        silent = (timeline.silence_end_s >= start_s) & (timeline.silence_start_s <= end_s)
        near = replace(
            near,
            silence_start_s=timeline.silence_start_s[silent],
            silence_end_s=timeline.silence_end_s[silent],
        )
        faps[first : first + block, np.array(MOUTH_FAPS) - 1] = blend(parameters, near, times)
    amplitude = AmplitudeModifier()
    articulation = VisemeArticulation(timeline, parameters.level_db)
    for number, (frame_s, faps_now) in enumerate(zip(time_s, faps, strict=True)):
        context = FrameContext(
            time_s=float(frame_s),
            known_s=np.inf,
            elapsed_s=float(frame_s),
            step_s=1.0 / frame_rate_hz,
            is_speaking=True,
            levels=levels if number == 0 else (),
            articulation=articulation,
        )
        amplitude.apply(faps_now, context)
    return faps
