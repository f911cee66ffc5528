"""What each lip model, and each baseline, makes of a clip.

Schemes of Li et al. 2011, section 3.2:

1. forced alignment of the transcript, full model (Mandarin clips with a transcript);
2. recognised phones with their times, full model;
3. every lip model live, at several delays: the frames that the services would send;
4. dynamic visemes live, but a phone counts only once the next one begins (at the default delay).

Two baselines need no phones: a mouth that opens with the loudness, at the same delays, and one
that stands still at its mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, aligned_phones
from kouxing.corpora.scoring import is_emitted
from kouxing.evaluation.lips.measures import is_near
from kouxing.services.live_chain import sound_events
from kouxing.services.mouth_profiles.lip_tracks import LEVEL_STEP_S, level_track
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lip_frames import LipFrameModel, LipFrameStream, delay_for
from kouxing.services.recognizer.offline import recognize
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.services.synthesizer.offline import synthesize
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.phones.events import LipFrame, Phone, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

DEFAULT_DELAY_S = SynthesizerConfig().delay_ms / 1e3
DELAYS_S = sorted({0.0, 0.05, 0.1, 0.16, 0.3, DEFAULT_DELAY_S})
NEXT_PHONE_DELAY_S = DEFAULT_DELAY_S
FRAME_RATE_HZ = 50.0
_HOP_S = 1.0 / FRAME_RATE_HZ
_LOUDNESS_RANGE_DB = 40.0
_LOUDNESS_WINDOW = np.hanning(7)  # frames
_SPEECH_RANGE_DB, _SPEECH_MARGIN_S = 30.0, 0.1
_PAUSE_S = 0.5
_QUIETEST_HOP_S = 0.01
_MEAN_OPENING = 250.0  # FAP units; only closures see it, means are removed


@dataclass(frozen=True, slots=True, kw_only=True)
class HeardClip:
    """A clip with what the recognizer makes of its sound."""

    clip: LipClip
    num_frames: int  # of synthesis
    levels: list[tuple[float, float]]  # seconds, dB of full scale
    events: Mapping[float, Sequence[SoundEvent]]  # of the live recognizer, by the face's delay in s
    inventory: PhoneInventory  # of the phones
    recognised: list[Phone]  # by offline decoding
    aligned: list[Phone] | None  # by the transcript


@dataclass(frozen=True, slots=True)
class Scheme:
    """A way to make frames (num_frames, 68) from a clip's sound; None: not from this clip."""

    name: str
    delay_s: float | None  # None: it knows the whole recording
    frames: Callable[[HeardClip], Array | None]


def hear(
    model: AcousticModel,
    clip: LipClip,
    lips: LipFrameModel | None,
    delays_s: Sequence[float] = DELAYS_S,
) -> HeardClip:
    """Recognise a clip live and offline, and align it with its text where that is known.

    Live, lip frames of the sound come in time for a face of each delay.
    """
    return HeardClip(
        clip=clip,
        num_frames=int(len(clip.samples) / SAMPLE_RATE_HZ * FRAME_RATE_HZ) + 1,
        levels=level_track(clip.samples),
        events=live_events(model, clip.samples, lips, delays_s),
        inventory=model.inventory,
        recognised=recognize(model, clip.samples, SAMPLE_RATE_HZ),
        aligned=aligned_phones(model, clip),
    )


@dataclass(frozen=True, slots=True)
class _SeveralDelays:
    """A model of lips that makes frames for faces of several delays at once."""

    lips: LipFrameModel
    delays_s: Sequence[float]

    def create_stream(self, _delays_s: Sequence[float]) -> LipFrameStream:
        return self.lips.create_stream(self.delays_s)

    def with_mouth_profile(self, profile: bytes) -> Self:
        return replace(self, lips=self.lips.with_mouth_profile(profile))


def live_events(
    model: AcousticModel,
    samples: NDArray[np.float32],
    lips: LipFrameModel | None,
    delays_s: Sequence[float],
    config: RecognizerConfig | None = None,
) -> dict[float, list[SoundEvent]]:
    """Return what ``sound_events`` returns for a face of each delay; the recognizer runs once."""
    if lips is None:
        return dict.fromkeys(delays_s, sound_events(model, samples, config=config))
    chosen = {delay_s: delay_for(lips.delays_s, delay_s) for delay_s in delays_s}
    several = _SeveralDelays(lips, sorted(set(chosen.values())))
    events = sound_events(model, samples, several, config=config)
    return {
        delay_s: [
            event
            for event in events
            if not isinstance(event, LipFrame) or math.isclose(event.delay_s, own, abs_tol=1e-4)
        ]
        for delay_s, own in chosen.items()
    }


def all_schemes(visemes: DynamicVisemes, lip_models: Mapping[str, LipModel]) -> list[Scheme]:
    """Return the schemes of some lip models by name, those of the visemes, and the baselines."""
    return [
        Scheme("aligned phones", None, lambda heard: full_frames(visemes, heard, heard.aligned)),
        Scheme(
            "recognised phones", None, lambda heard: full_frames(visemes, heard, heard.recognised)
        ),
        *(
            live_scheme(name, lips, delay)
            for name, lips in lip_models.items()
            for delay in DELAYS_S
        ),
        next_phone_scheme(visemes),
        *(loudness_scheme(delay_s) for delay_s in DELAYS_S),
        Scheme("mean mouth", None, mean_mouth),
    ]


def live_scheme(name: str, lips: LipModel, delay_s: float) -> Scheme:
    """Return what the live chain makes with a lip model and a delay."""
    return Scheme(
        name,
        delay_s,
        lambda heard: live_frames(lips, heard.events[delay_s], delay_s, FRAME_RATE_HZ),
    )


def next_phone_scheme(visemes: DynamicVisemes) -> Scheme:
    """Return scheme 4."""
    return Scheme(
        "next phone",
        NEXT_PHONE_DELAY_S,
        lambda heard: live_frames(
            visemes,
            once_the_next_begins(heard.events[NEXT_PHONE_DELAY_S]),
            NEXT_PHONE_DELAY_S,
            FRAME_RATE_HZ,
        ),
    )


def loudness_scheme(delay_s: float) -> Scheme:
    """Return the mouth that opens with the loudness."""
    return Scheme("loudness", delay_s, lambda heard: loudness_frames(heard.clip.samples, delay_s))


def full_frames(
    visemes: DynamicVisemes, heard: HeardClip, phones: Sequence[Phone] | None
) -> Array | None:
    """Frames (num_frames, 68) of the full model from phones, if they are known."""
    if phones is None:
        return None
    return synthesize(visemes, phones, heard.num_frames, FRAME_RATE_HZ, heard.levels).astype(float)


def live_frames(
    lips: LipModel, events: Sequence[SoundEvent], delay_s: float, frame_rate_hz: float
) -> Array:
    """Frames (num_frames, 68) that the live chain makes of sound events, without idle motion."""
    face = FaceAnimator(lips, frame_rate_hz=frame_rate_hz, delay_s=delay_s)
    return np.array([faps for _, faps in animate_live(face, events)], dtype=float)


def animate_live(face: FaceAnimator, events: Sequence[SoundEvent]) -> list[Frame]:
    """All frames that a face makes of sound events."""
    return [frame for event in events for frame in face.process(event)]


def once_the_next_begins(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Leave out each phone's first hypothesis: what comes with the next phone remains."""
    return [
        event
        for event, after in zip_longest(events, events[1:])
        if not (
            isinstance(event, Phone)
            and is_emitted(event, after if isinstance(after, Phone) else None)
        )
    ]


def loudness_frames(samples: NDArray[np.float32], delay_s: float) -> Array:
    """Frames (num_frames, 68) of a mouth that opens with the level, 0 to 1 over 40 dB.

    The level is smoothed over what is known a delay after the frame. How loud the loudest frames
    of the recording are is known from the start, which flatters this baseline.
    """
    hop = round(SAMPLE_RATE_HZ * _HOP_S)
    num_frames = len(samples) // hop + 1
    padded = np.pad(samples.astype(float), (hop, 2 * hop))
    power = [np.mean(padded[k * hop : (k + 2) * hop] ** 2) for k in range(num_frames)]
    level_db = 10.0 * np.log10(np.array(power) + 1e-10)
    loudest_db = np.percentile(level_db, 95)
    level = np.clip((level_db - loudest_db) / _LOUDNESS_RANGE_DB + 1.0, 0.0, 1.0)
    reach = len(_LOUDNESS_WINDOW) // 2
    known = np.arange(1 - reach, reach + 2) * _HOP_S <= delay_s + 1e-9  # ends of the levels' sound
    window = np.where(known, _LOUDNESS_WINDOW, 0.0)
    level = np.correlate(np.pad(level, reach), window / window.sum(), mode="valid")
    faps = np.zeros((num_frames, NUM_FAPS))
    faps[:, 2], faps[:, 4] = 300.0 * level, -600.0 * level
    return faps


def mean_mouth(heard: HeardClip) -> Array:
    """Frames (num_frames, 68) of a mouth that stands still, half open."""
    faps = np.zeros((heard.num_frames, NUM_FAPS))
    faps[:, 4] = -_MEAN_OPENING
    return faps


def is_speech(heard: HeardClip, time_s: Array) -> NDArray[np.bool_]:
    """Tell of some times whether somebody speaks then.

    That is while the recognizer's voice activity is on, within 0.1 s of sound that is less than
    30 dB below the loudest. Voice activity alone spans pauses of half a second, the level alone
    takes noise for speech.
    """
    speech: NDArray[np.bool_] = _is_active(heard, time_s) & is_near(
        time_s, _loud_s(heard), _SPEECH_MARGIN_S
    )
    return speech


def pauses(heard: HeardClip) -> Array:
    """Where half a second and more is silent after speech, seconds, shape (num_pauses, 2).

    A pause goes from the last sound that is less than 30 dB below the loudest, while the
    recognizer's voice activity is on, to the next such sound or the end of the clip.
    """
    loud_s = _loud_s(heard)
    spoken_s = loud_s[_is_active(heard, loud_s)]
    edges_s = np.append(spoken_s, len(heard.clip.samples) / SAMPLE_RATE_HZ)
    is_pause = np.diff(edges_s) >= _PAUSE_S
    return np.stack([edges_s[:-1][is_pause], edges_s[1:][is_pause]], axis=1)


def _is_active(heard: HeardClip, time_s: Array) -> NDArray[np.bool_]:
    """Tell of some times whether the recognizer's voice activity is on."""
    events = next(iter(heard.events.values()))  # voice activity is the same for all delays
    changes = [event for event in events if isinstance(event, SpeechChange)]
    after = np.searchsorted([change.time_s for change in changes], time_s, side="right")
    return np.array([False, *(change.active for change in changes)])[after]


def _loud_s(heard: HeardClip) -> Array:
    """When the sound is less than 30 dB below the loudest, seconds."""
    if not heard.levels:
        return np.zeros(0)
    end_s, level_db = np.array(heard.levels).T
    is_loud = level_db > np.percentile(level_db, 95) - _SPEECH_RANGE_DB
    loud_s: Array = end_s[is_loud] - LEVEL_STEP_S / 2.0
    return loud_s


def phones_shaped(heard: HeardClip, viseme: str) -> list[Phone]:
    """Phones of a clip that begin with a viseme; none where the language is not the model's."""
    if heard.clip.language != heard.inventory.code:
        return []
    visemes = heard.inventory.visemes
    return [
        phone
        for phone in heard.aligned or heard.recognised
        if visemes[phone.symbol][0][0] == viseme
    ]


def quietest_moments(clip: LipClip, phones: Sequence[Phone]) -> Array:
    """When some phones of a clip are quietest, seconds."""
    hop = round(_QUIETEST_HOP_S * SAMPLE_RATE_HZ)
    power = np.square(clip.samples[: len(clip.samples) // hop * hop], dtype=float)
    level = power.reshape(-1, hop).mean(axis=1)
    moments = []
    for phone in phones:
        first = round(phone.onset_s / _QUIETEST_HOP_S)
        last = max(round((phone.onset_s + phone.duration_s) / _QUIETEST_HOP_S), first + 1)
        if first < len(level):
            moments.append((first + int(np.argmin(level[first:last])) + 0.5) * _QUIETEST_HOP_S)
    return np.array(moments)
