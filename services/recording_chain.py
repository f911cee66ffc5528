"""Animates a face from a whole recording.

    sound -> scores -> phones, by offline decoding or forced alignment of a known text
                    -> lip frames with the longest delay
                    -> face

The face is the one of the live chain (``Face``), with the same lip models and modifiers. It has the
longest delay, 1.5 s, so that everything that affects a frame is known. Dynamic visemes blend all
visemes within 1.5 s (Wang & Cai 2003, eq. 6); the weight of others is too small to see. With learnt
lips, phones also decide where the lips do not close. In the live chain, they arrive too late.
"""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.features import frame_time_s
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.recognizer.lip_frames import LipFrameModel
from kouxing.services.recognizer.offline import decode_offline
from kouxing.services.recognizer.speech_scorer import (
    ScoreEvent,
    WithProgress,
    score_recording,
)
from kouxing.services.recognizer.speech_segmenter import SpeechEnd, SpeechStart
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import MAX_DELAY_S, REST_S, FaceAnimator, Frame
from kouxing.services.synthesizer.lips.learnt.closures import ClosureRule
from kouxing.services.synthesizer.lips.learnt.model import LearntLips
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.phones.events import EndOfSound, LipPositions, Phone, SoundEvent, SpeechChange

# Tuned on the same held-out clips as the rule of the live chain. If the sound has one closure and
# the phones have two, the vowel between them counts. No clip has such a place.
_RECOGNIZED = ClosureRule(other=1.0, vowel=3.0)
_KNOWN_TEXT = ClosureRule(phone=6.0, other=6.0)  # the phones decide


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalyzedRecording:
    """Everything that moves a face, for a whole recording."""

    duration_s: float
    events: Sequence[SoundEvent]  # phones, lip frames, voice activity and levels; not sorted
    is_text_known: bool

    @property
    def phones(self) -> list[Phone]:
        """Phones with their times, including silence."""
        return [event for event in self.events if isinstance(event, Phone)]


def recognize_recording(
    model: AcousticModel, samples: NDArray[np.float32], with_progress: WithProgress = iter
) -> list[Phone]:
    """Return the phones of ``analyze_recording``, which has the parameters."""
    return decode_offline(
        model,
        score_recording(
            model, samples, MEDIA_RATE_HZ, silence_s=MAX_DELAY_S, with_progress=with_progress
        ),
    )


def analyze_recording(
    model: AcousticModel,
    samples: NDArray[np.float32],
    lip_predictor: LipFrameModel | None = None,
    aligned: Sequence[Phone] | None = None,
    with_progress: WithProgress = iter,
) -> AnalyzedRecording:
    """Find the phones, lip frames, voice activity and levels of a recording.

    Parameters
    ----------
    model
        The acoustic model.
    samples
        16 kHz mono, shape (n,).
    lip_predictor
        The network that predicts learnt lips, if any.
    aligned
        The phones of the known text; None: phones are recognized.
    with_progress
        Shows the progress.
    """
    lip_stream = None
    if lip_predictor is not None:
        lip_stream = lip_predictor.create_stream(lip_predictor.delays_s[-1:])
    lip_positions: list[LipPositions] = []
    changes: list[SpeechChange] = []

    def scores() -> Iterator[ScoreEvent]:
        """Yield the events for decoding, and collect the others."""
        for event in score_recording(
            model,
            samples,
            MEDIA_RATE_HZ,
            lip_stream,
            silence_s=MAX_DELAY_S,
            with_progress=with_progress,
        ):
            if isinstance(event, LipPositions):
                if event.time_s >= 0.0:
                    lip_positions.append(event)
                continue
            if isinstance(event, SpeechStart | SpeechEnd):
                is_start = isinstance(event, SpeechStart)
                changes.append(SpeechChange(active=is_start, time_s=frame_time_s(event.frame)))
            yield event

    if aligned is None:
        phones = decode_offline(model, scores())
    else:
        phones = [replace(phone, confidence=1.0) for phone in aligned]
        deque(scores(), maxlen=0)
    return AnalyzedRecording(
        duration_s=len(samples) / MEDIA_RATE_HZ,
        events=[*phones, *lip_positions, *changes, *progress_of(samples, MAX_DELAY_S)],
        is_text_known=aligned is not None,
    )


def animate_recording(
    recording: AnalyzedRecording,
    lip_model: LipModel,
    config: SynthesizerConfig,
    with_progress: WithProgress = iter,
) -> list[Frame]:
    """Return all frames of a recording, until the face is at rest. ``delay_ms`` is ignored.

    ``with_progress`` shows the progress.
    """
    if isinstance(lip_model, LearntLips):
        lip_model = replace(
            lip_model, closures=_KNOWN_TEXT if recording.is_text_known else _RECOGNIZED
        )
    face = FaceAnimator(
        lip_model,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=MAX_DELAY_S,
        idle_motion_seed=config.idle_motion_seed,
        expressiveness=config.expressiveness,
    )
    end = EndOfSound(time_s=recording.duration_s + MAX_DELAY_S)
    frames = [
        frame
        for event in with_progress([*sorted(recording.events, key=_time_of), end])
        for frame in face.process(event)
    ]
    return [frame for frame in frames if frame[0] <= recording.duration_s + REST_S]


def _time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s
