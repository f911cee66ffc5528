"""Frames of the package ``kouxing-lips`` and of the server."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.system import lips_package
from kouxing.evaluation.system.lips_package import package_faps
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.phones.events import LipPositions, Progress, SoundEvent, SpeechChange

RATE_HZ = 16_000
DELAY_S, FRAME_RATE_HZ = 0.06, 50.0
TONGUE = [13, 43, 44, 45, 46]  # FAPs 14, and 44 to 47: jaw thrust and tongue
Frames = NDArray[np.float32]


def package_output(models: Path, samples: Frames, **options: Any) -> dict[str, Any]:
    return lips_package.package_output(
        models, samples, **{"chunk": 441, "shapes": [*SHAPE_SETS], **options}
    )


def faps_of(models: Path, samples: Frames, **options: Any) -> Frames:
    return package_faps(package_output(models, samples, **options))


def server_faps(events: Sequence[SoundEvent], **settings: float) -> Frames:
    """Return the server's frames without idle motion and tongue."""
    faps = lips_package.server_faps(events, **settings)
    faps[:, TONGUE] = 0.0
    return faps


def closure_at_the_end_of_speech() -> list[SoundEvent]:
    """Return events of lips that are closing fast when the speech ends."""
    openings = [1.0] * 20 + [0.1]
    lip_faps = [MOUTH_FAPS.index(fap) for fap in (4, 5, 8, 9, 10, 11, 51, 52, 55, 56, 57, 58)]
    events: list[SoundEvent] = [SpeechChange(active=True, time_s=0.0)]
    for number in range(40):
        time_s = number / FRAME_RATE_HZ
        if number < len(openings):
            faps = np.zeros(len(MOUTH_FAPS), np.float32)
            faps[lip_faps] = -200.0 * openings[number]
            events.append(
                LipPositions(
                    time_s=time_s, delay_s=DELAY_S, faps=faps, closure=0.01, lip_to_teeth=0.0
                )
            )
        if number == len(openings):
            events.append(SpeechChange(active=False, time_s=time_s + DELAY_S))
        events.append(Progress(time_s=time_s + DELAY_S, level_db=-20.0))
    return events
