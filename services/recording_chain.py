"""A whole recording to FAP frames, with everything known.

    sound -> scores -> phones: offline decoding, or those of a known text
                    -> lip frames of the longest delay                   -> face, 1.5 s later

The face is that of the live chain (``Face``), with the same lip models and modifiers. It is made so
late that everything is known that moves a frame: dynamic visemes blend all visemes within 1.5 s
(Wang & Cai 2003, eq. 6); beyond that they weigh less than a face can show. The phones of learnt
lips say where lips do not meet, too; live, they are known too late for that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.recognizer.lip_source import LipsFromSound
from kouxing.services.recognizer.offline import decode_offline
from kouxing.services.recognizer.speech_scores import (
    SpeechEnd,
    SpeechStart,
    frame_time_s,
    score_recording,
)
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face import MAX_DELAY_S, REST_S, Face, Frame
from kouxing.services.synthesizer.lips.learnt.closures import ClosureRule
from kouxing.services.synthesizer.lips.learnt.model import LearntLips
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.phones.events import EndOfSound, LipFrame, Phone, SoundEvent, SpeechChange

# Chosen on clips for choices, as those of the live chain. Where the sound tells one closure and the
# phones two, the vowel between them counts; no clip has such a place.
_RECOGNISED = ClosureRule(other=1.0, vowel=3.0)
_CERTAIN = ClosureRule(phone=6.0, other=6.0)  # of a known text: its phones decide


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardRecording:
    """What is known of a whole recording."""

    duration_s: float
    events: Sequence[SoundEvent]  # phones, lip frames, voice activity and levels, in any order
    is_text_known: bool

    @property
    def phones(self) -> list[Phone]:
        """Its phones with their times, silence included."""
        return [event for event in self.events if isinstance(event, Phone)]


def hear_recording(
    model: AcousticModel,
    samples: NDArray[np.float32],
    lips_from_sound: LipsFromSound | None = None,
    aligned: Sequence[Phone] | None = None,
) -> HeardRecording:
    """Find out all about a recording.

    Parameters
    ----------
    model
        The acoustic model.
    samples
        16 kHz mono, shape (n,).
    lips_from_sound
        The recognizer's model of lips, if it fits the acoustic model.
    aligned
        The phones, if the text is known.
    """
    silence = np.zeros(round(MAX_DELAY_S * MEDIA_RATE_HZ), np.float32)  # the face is as late
    padded = np.concatenate([samples, silence])
    lips = None
    if lips_from_sound is not None:
        lips = lips_from_sound.stream(lips_from_sound.delays_s[-1:])
    events = score_recording(model, padded, MEDIA_RATE_HZ, lips)
    phones = decode_offline(model, events) if aligned is None else aligned
    return HeardRecording(
        duration_s=len(samples) / MEDIA_RATE_HZ,
        events=[
            *(phone if aligned is None else replace(phone, confidence=1.0) for phone in phones),
            *(event for event in events if isinstance(event, LipFrame) and event.time_s >= 0.0),
            *(
                SpeechChange(
                    active=isinstance(event, SpeechStart), time_s=frame_time_s(event.frame)
                )
                for event in events
                if isinstance(event, SpeechStart | SpeechEnd)
            ),
            *progress_of(padded),
        ],
        is_text_known=aligned is not None,
    )


def animate(heard: HeardRecording, lips: LipModel, config: SynthesizerConfig) -> list[Frame]:
    """Make all frames of a recording, with those that lead to rest; ``delay_ms`` is ignored."""
    if isinstance(lips, LearntLips):
        lips = replace(lips, closures=_CERTAIN if heard.is_text_known else _RECOGNISED)
    face = Face(
        lips,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=MAX_DELAY_S,
        idle_motion_seed=config.idle_motion_seed,
        expressiveness=config.expressiveness,
    )
    end = EndOfSound(time_s=heard.duration_s + MAX_DELAY_S)
    frames = [
        frame
        for event in [*sorted(heard.events, key=_time_of), end]
        for frame in face.accept(event)
    ]
    return [frame for frame in frames if frame[0] <= heard.duration_s + REST_S]


def _time_of(event: SoundEvent) -> float:
    return event.onset_s if isinstance(event, Phone) else event.time_s
