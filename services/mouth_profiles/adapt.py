"""Learn a mouth profile from one speaker's recordings, and measure what it improves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.services.mouth_profiles.learning import (
    FilmedSpeech,
    Observations,
    ProfileGain,
    fit_profile,
    measure_gain,
    observe,
)
from kouxing.services.mouth_profiles.lip_tracks import MEASURES
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.shared.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedProfile:
    """A mouth profile and what it improves."""

    content: bytes
    speech_s: float  # speech that it was learned from
    gain: ProfileGain  # of a profile that was learned from the first three quarters

    def figures(self) -> dict[str, object]:
        """Return the figures that ``kouxing adapt --json`` writes, see ``docs/my_mouth.md``."""
        gain = self.gain
        curves = {
            measure: dict(zip(("tracked", "before", "after"), map(_plain, curve), strict=True))
            for measure, curve in zip(MEASURES, gain.curves, strict=True)
        }
        return {
            "speech_s": self.speech_s,
            "held_back_s": gain.speech_s,
            "delay_ms": 1e3 * gain.delay_s,
            "before": dict(zip(MEASURES, _plain(gain.before), strict=True)),
            "after": dict(zip(MEASURES, _plain(gain.after), strict=True)),
            "curves": {"time_s": _plain(gain.time_s), **curves},
        }


def learn_mouth_profile(recordings: Sequence[FilmedSpeech]) -> LearnedProfile:
    """Learn a mouth profile; UserError if there is too little speech with lips in view."""
    model = load_model()
    lips = lip_predictor_for(model)
    if lips is None or not isinstance(model, NeuralModel):
        raise UserError("the shipped lip model and acoustic model do not match; reinstall kouxing")
    observations = Observations.join([observe(model, lips, filmed) for filmed in recordings])
    return LearnedProfile(
        content=fit_profile(observations).to_bytes(lips.digest),
        speech_s=len(observations) * POSITION_S,
        gain=measure_gain(lips, observations),
    )


def _plain(values: NDArray[np.float64]) -> list[float | None]:
    """Convert numbers to JSON values; NaN becomes None."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in values]
