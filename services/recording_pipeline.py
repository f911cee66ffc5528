"""Animates a face from a whole recording.

    sound -> phones, recognized as in live audio, or by forced alignment of a known text
          -> lip positions with the longest delay
          -> face

The live pipeline's ``FaceAnimator`` makes the face, with the same lip models and modifiers. It has
the longest delay, 1.5 s, so that everything that affects a frame is known. Dynamic visemes blend
all visemes within 1.5 s (Wang & Cai 2003, eq. 6); more distant visemes have no visible weight.
With learned lips, phones can also prevent closures. In the live pipeline, phones arrive too late
for this.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kouxing.services.recognizer.front_end.features import frame_time_s
from kouxing.services.recognizer.front_end.slices import SliceMeter
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.lips.lip_prediction import LipPredictor
from kouxing.services.recognizer.live.speech_segmenter import (
    SpeechEnd,
    SpeechItem,
    SpeechSegmenter,
    SpeechStart,
)
from kouxing.services.recognizer.offline.offline_recognition import WithProgress
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import MAX_DELAY_S, REST_S, Frame, configured_face
from kouxing.services.synthesizer.lips.learned.closure_rule import ClosureRule
from kouxing.services.synthesizer.lips.learned.model import LearnedLips
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import (
    EndOfSound,
    LipPositions,
    Phone,
    SoundEvent,
    SpeechChange,
    time_of,
)

# Tuned on the same held-out clips as the rule of the live pipeline, except ``vowel``: no clip has
# one closure in the sound and two in the phones.
_RECOGNIZED = ClosureRule(other=1.0, vowel=3.0)
_KNOWN_TEXT = ClosureRule(phone=6.0, other=6.0)  # phones outweigh the sound


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalyzedRecording:
    """All inputs of a face, for a whole recording."""

    duration_s: float
    events: Sequence[SoundEvent]  # phones, lip positions, voice activity and levels; not sorted
    is_text_known: bool

    @property
    def phones(self) -> list[Phone]:
        """Phones with their times, including silence."""
        return [event for event in self.events if isinstance(event, Phone)]


def analyze_recording(
    samples: Floats,
    phones: Sequence[Phone],
    lip_predictor: LipPredictor | None = None,
    *,
    is_text_known: bool = True,
    with_progress: WithProgress = iter,
) -> AnalyzedRecording:
    """Find the lip positions, voice activity and levels of a recording, 16 kHz mono, shape (n,).

    ``phones`` are recognized, or come from a known text. Without ``lip_predictor``, there are no
    lip positions. ``with_progress`` wraps the loop to show progress.
    """
    lip_stream = None
    if lip_predictor is not None:
        lip_stream = lip_predictor.create_stream(lip_predictor.delays_s[-1:])
    segmenter = SpeechSegmenter(WhisperMel(), lip_stream)
    events: list[SoundEvent] = []

    def add_events(items: Iterable[SpeechItem]) -> None:
        for item in items:
            if isinstance(item, SpeechStart | SpeechEnd):
                is_start = isinstance(item, SpeechStart)
                events.append(SpeechChange(active=is_start, time_s=frame_time_s(item.frame)))
            elif isinstance(item, LipPositions) and item.time_s >= 0.0:
                events.append(item)

    meter = SliceMeter()
    silence = np.zeros(round(MAX_DELAY_S * MEDIA_RATE_HZ), np.float32)
    for start in with_progress(range(0, len(samples) + len(silence), MEDIA_RATE_HZ)):
        second = samples[start : start + MEDIA_RATE_HZ]
        if num_missing := MEDIA_RATE_HZ - len(second):
            second, silence = np.append(second, silence[:num_missing]), silence[num_missing:]
        for piece, progress in meter.accept_waveform(second):
            add_events(segmenter.accept_waveform(piece))
            if progress is not None:
                events.append(replace(progress, **segmenter.traits._asdict()))
    add_events(segmenter.input_finished())
    if is_text_known:
        phones = [replace(phone, confidence=1.0) for phone in phones]
    return AnalyzedRecording(
        duration_s=len(samples) / MEDIA_RATE_HZ,
        events=[*phones, *events],
        is_text_known=is_text_known,
    )


def animate_recording(
    recording: AnalyzedRecording,
    lip_model: LipModel,
    config: SynthesizerConfig,
    with_progress: WithProgress = iter,
) -> list[Frame]:
    """Return all frames of a recording, until the face is at rest.

    ``delay_ms`` is ignored. ``with_progress`` wraps the loop to show progress.
    """
    if isinstance(lip_model, LearnedLips):
        lip_model = dataclasses.replace(
            lip_model, closures=_KNOWN_TEXT if recording.is_text_known else _RECOGNIZED
        )
    face = configured_face(lip_model, config, delay_s=MAX_DELAY_S)
    end = EndOfSound(time_s=recording.duration_s + MAX_DELAY_S)
    frames = [
        frame
        for event in with_progress([*sorted(recording.events, key=time_of), end])
        for frame in face.process(event)
    ]
    return [frame for frame in frames if frame[0] <= recording.duration_s + REST_S]
