"""The frames that live services would send for a recording."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Self

import numpy as np

from kouxing.corpora.scoring import is_emitted
from kouxing.services.live_pipeline import recognize_events
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lips.lip_prediction import (
    LipPredictor,
    LipPredictorStream,
    choose_delay,
)
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.phones.events import LipPositions, Phone, SoundEvent

Samples = Floats
FRAME_RATE_HZ = 50.0


@dataclass(frozen=True, slots=True)
class _MultiDelayPredictor:
    """A lip predictor that predicts for several delays in one run of the recognizer."""

    predictor: LipPredictor
    delays_s: Sequence[float]

    def create_stream(self, _delays_s: Sequence[float]) -> LipPredictorStream:
        return self.predictor.create_stream(
            [delay_s for delay_s in self.predictor.delays_s if delay_s in self.delays_s]
        )

    def with_mouth_profile(self, _profile: bytes) -> Self:
        return self


def live_events(
    model: AcousticModel,
    samples: Samples,
    lips: LipPredictor | None,
    delays_s: Sequence[float],
    config: RecognizerConfig | None = None,
) -> dict[float, list[SoundEvent]]:
    """Return the sound events of a lip predictor's faces by their delay, seconds.

    The recognizer runs once. With None for ``lips``, there are no lip positions.
    """
    if lips is None:
        return dict.fromkeys(delays_s, recognize_events(model, samples, None, config=config))
    chosen_s = {delay_s: choose_delay(lips.delays_s, delay_s) for delay_s in delays_s}
    several = _MultiDelayPredictor(lips, [*chosen_s.values()])
    events = recognize_events(model, samples, several, config=config)
    return {
        delay_s: [
            event
            for event in events
            if not isinstance(event, LipPositions)
            or math.isclose(event.delay_s, lips_s, abs_tol=1e-4)
        ]
        for delay_s, lips_s in chosen_s.items()
    }


def live_frames(lips: LipModel, events: Sequence[SoundEvent], delay_s: float) -> Doubles:
    """Return frames (num_frames, 68) of the live pipeline, without idle motion."""
    face = FaceAnimator(lips, frame_rate_hz=FRAME_RATE_HZ, delay_s=delay_s)
    return np.array([faps for _, faps in animate_live(face, events)], dtype=float)


def animate_live(face: FaceAnimator, events: Sequence[SoundEvent]) -> list[Frame]:
    """Return all frames that a face makes for sound events."""
    return [frame for event in events for frame in face.process(event)]


def drop_first_hypotheses(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Remove each phone's first hypothesis. What arrives with the next phone remains."""
    return [
        event
        for event, after in zip_longest(events, events[1:])
        if not (isinstance(event, Phone) and is_emitted(event, after))
    ]
