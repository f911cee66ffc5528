"""What every modifier offers: it changes a FAP frame after the lip model has set the mouth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.lip_model import Articulation


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """What is known when a frame is made."""

    time_s: float  # media time of the frame
    known_s: float  # media time up to which the sound is known
    elapsed_s: float  # since the first frame; goes on while media time stands still
    step_s: float  # since the frame before
    is_speaking: bool  # somebody speaks, or is known to begin in a moment
    levels: Sequence[tuple[float, float]]  # new since the frame before: media time s, level dB
    articulation: Articulation
    pitches: Sequence[tuple[float, float]] = ()  # of voices, new as well: media time s, Hz
    amplitude_applies: bool = True  # else the lips follow the level already


class Modifier(Protocol):
    """Changes one session's frames; it may remember earlier ones."""

    def apply(self, faps: NDArray[np.float32], moment: Moment) -> None:
        """Change a frame, FAPs (68,) in FAP units, in place."""
