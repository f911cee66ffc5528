"""The trajectory defined by a timeline of visemes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import VisemeParameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline
from kouxing.services.synthesizer.lips.trajectory import FapState

_STEP_S = 1e-3  # of the numerical derivative


@dataclass(frozen=True, slots=True)
class TargetTrajectory:
    """The trajectory of the mouth FAPs for a timeline."""

    parameters: VisemeParameters
    timeline: Timeline

    def at(self, time_s: float) -> FapState:
        """Return position and velocity at a media time."""
        times = np.array([time_s - _STEP_S, time_s, time_s + _STEP_S])
        before, here, after = blend(self.parameters, self.timeline, times)
        return FapState(here, (after - before) / (2.0 * _STEP_S))
