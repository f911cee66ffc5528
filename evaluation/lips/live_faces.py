"""The frames that live services would send for a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.scoring import is_emitted
from kouxing.services.live_chain import sound_events
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lip_frames import LipFrameModel, LipFrameStream, delay_for
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.phones.events import LipPositions, Phone, SoundEvent

Samples = NDArray[np.float32]
FRAME_RATE_HZ = 50.0


class _NumberedLipPositions(LipPositions, frozen=True, kw_only=True):
    """Lip positions of one of several predictors."""

    predictor: int


@dataclass(frozen=True, slots=True)
class _SeveralPredictors:
    """Runs several lip predictors, each with several delays, on one run of the recognizer."""

    predictors: Sequence[LipFrameModel]
    delays_s: Sequence[float]  # delays of all predictors

    def create_stream(self, _delays_s: Sequence[float]) -> _SeveralStreams:
        return _SeveralStreams(
            [
                predictor.create_stream([d for d in predictor.delays_s if d in self.delays_s])
                for predictor in self.predictors
            ]
        )

    def with_mouth_profile(self, _profile: bytes) -> Self:
        return self


@dataclass(frozen=True, slots=True)
class _SeveralStreams:
    streams: Sequence[LipFrameStream]

    def process_position(
        self, known_s: float, frames: NDArray[np.float32], features: NDArray[np.float32]
    ) -> list[LipPositions]:
        return [
            _NumberedLipPositions(
                time_s=lips.time_s,
                delay_s=lips.delay_s,
                faps=lips.faps,
                closure=lips.closure,
                lip_to_teeth=lips.lip_to_teeth,
                predictor=number,
            )
            for number, stream in enumerate(self.streams)
            for lips in stream.process_position(known_s, frames, features)
        ]

    def reset(self) -> None:
        for stream in self.streams:
            stream.reset()


def events_of_faces(
    model: AcousticModel,
    samples: Samples,
    faces: Sequence[tuple[LipFrameModel | None, float]],
    config: RecognizerConfig | None = None,
) -> list[list[SoundEvent]]:
    """Return the sound events that each face receives, with one run of the recognizer.

    A face has a lip predictor, or None, and a delay in seconds.
    """
    predictors = {id(lips): lips for lips, _ in faces if lips is not None}
    numbers = {key: number for number, key in enumerate(predictors)}
    sources = [
        None if lips is None else (numbers[id(lips)], delay_for(lips.delays_s, delay_s))
        for lips, delay_s in faces
    ]
    delays_s = sorted({source[1] for source in sources if source})
    several = _SeveralPredictors([*predictors.values()], delays_s) if predictors else None
    events = sound_events(model, samples, several, config=config)
    return [[event for event in events if _is_for(event, source)] for source in sources]


def _is_for(event: SoundEvent, source: tuple[int, float] | None) -> bool:
    if not isinstance(event, _NumberedLipPositions):
        return True
    if source is None:
        return False
    number, delay_s = source
    return event.predictor == number and math.isclose(event.delay_s, delay_s, abs_tol=1e-4)


def live_events(
    model: AcousticModel,
    samples: Samples,
    lips: LipFrameModel | None,
    delays_s: Sequence[float],
    config: RecognizerConfig | None = None,
) -> dict[float, list[SoundEvent]]:
    """Return the sound events of a lip predictor's faces by their delay, seconds."""
    faces = [(lips, delay_s) for delay_s in delays_s]
    return dict(zip(delays_s, events_of_faces(model, samples, faces, config), strict=True))


def live_frames(
    lips: LipModel, events: Sequence[SoundEvent], delay_s: float
) -> NDArray[np.float64]:
    """Return frames (num_frames, 68) of the live chain, without idle motion."""
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
        if not (
            isinstance(event, Phone)
            and is_emitted(event, after if isinstance(after, Phone) else None)
        )
    ]
