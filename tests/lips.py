"""Made-up speakers with tracked lips."""

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.visemes import MOUTH_FAPS
from shared.phones import Phone
from training.lip_clips import LipClip

JAW, LOWER_LIP, WIDTH = (MOUTH_FAPS.index(fap) for fap in (3, 5, 6))


def utterance(seed: int, num_units: int) -> list[Phone]:
    rng = np.random.default_rng(seed)
    onset_s, phones = 0.3, []
    for index in range(num_units):
        unit = str(rng.choice(["d", "g", "sh", "b"] if index % 2 == 0 else ["a", "i", "u"]))
        duration_s = float(rng.uniform(0.06, 0.25))
        phones.append(
            Phone(
                index=index,
                unit=unit,
                onset_s=onset_s,
                duration_s=duration_s,
                confidence=1.0,
                final=True,
            )
        )
        onset_s += duration_s + (0.5 if rng.random() < 0.15 and index % 2 else 0.0)
    return phones


def clip_of(time_s: NDArray[np.float64], faps: NDArray[np.float64]) -> LipClip:
    return LipClip(
        name="made_up",
        speaker="nobody",
        licence="CC0",
        part="held",
        transcript="",
        time_s=time_s,
        faps=faps,
        samples=np.zeros(0, dtype=np.float32),
    )
