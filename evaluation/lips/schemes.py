"""The lips that each lip model, and each baseline, makes for a clip.

The schemes of Li et al. 2011, section 3.2:

1. Phones from forced alignment of the transcript. All phones are known. Mandarin clips only.
2. Recognized phones. All phones are known.
3. Every lip model live, at several delays: the frames that the services would send.
4. Dynamic visemes live, but a phone counts only once the next one starts.

Two baselines need no phones: a mouth that opens with the loudness, and a still mouth.
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
from kouxing.evaluation.lips.full_model import synthesize
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
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.phones.events import LipPositions, Phone, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

DEFAULT_DELAY_S = SynthesizerConfig().delay_ms / 1e3
DELAYS_S = sorted({0.0, 0.05, 0.1, 0.16, 0.3, DEFAULT_DELAY_S})
FRAME_RATE_HZ = 50.0
_LOUDNESS_RANGE_DB = 40.0
_LOUDNESS_WINDOW = np.hanning(7)  # frames
_SPEECH_RANGE_DB, _SPEECH_MARGIN_S = 30.0, 0.1
_POWER_STEP_S = 0.01
_LABIAL = "b"  # viseme of b p m
_STILL_OPENING = 250.0  # FAP units; it affects only closures, because means are removed


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizedClip:
    """A clip with the recognizer's output for its audio."""

    clip: LipClip
    num_frames: int  # at FRAME_RATE_HZ
    levels: list[tuple[float, float]]  # seconds, dB of full scale
    events: Mapping[float, Sequence[SoundEvent]]  # live output, by the face's delay in seconds
    inventory: PhoneInventory
    recognized: list[Phone]  # by offline decoding
    aligned: list[Phone] | None  # by forced alignment of the transcript


@dataclass(frozen=True, slots=True)
class Scheme:
    """A way to make frames (num_frames, 68) for a clip; None if it does not apply to the clip."""

    name: str
    delay_s: float | None  # None: it uses the whole recording
    frames: Callable[[RecognizedClip], Array | None]


def recognize_clip(
    model: AcousticModel,
    clip: LipClip,
    lips: LipFrameModel | None,
    delays_s: Sequence[float] = DELAYS_S,
) -> RecognizedClip:
    """Recognize a clip live and offline, and align its transcript, if it has one."""
    return RecognizedClip(
        clip=clip,
        num_frames=int(len(clip.samples) / SAMPLE_RATE_HZ * FRAME_RATE_HZ) + 1,
        levels=level_track(clip.samples),
        events=live_events(model, clip.samples, lips, delays_s),
        inventory=model.inventory,
        recognized=recognize(model, clip.samples, SAMPLE_RATE_HZ),
        aligned=aligned_phones(model, clip),
    )


@dataclass(frozen=True, slots=True)
class _SeveralDelays:
    """Makes lip frames for faces of several delays in one run."""

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
    """Return the result of ``sound_events`` for several delays, with one run of the recognizer."""
    if lips is None:
        return dict.fromkeys(delays_s, sound_events(model, samples, config=config))
    lip_delays_s = {delay_s: delay_for(lips.delays_s, delay_s) for delay_s in delays_s}
    several = _SeveralDelays(lips, sorted(set(lip_delays_s.values())))
    events = sound_events(model, samples, several, config=config)
    return {
        delay_s: [
            event
            for event in events
            if not isinstance(event, LipPositions)
            or math.isclose(event.delay_s, lip_delay_s, abs_tol=1e-4)
        ]
        for delay_s, lip_delay_s in lip_delays_s.items()
    }


def all_schemes(visemes: DynamicVisemes, lip_models: Mapping[str, LipModel]) -> list[Scheme]:
    """Return all schemes and baselines."""

    def full_frames(clip: RecognizedClip, phones: Sequence[Phone] | None) -> Array | None:
        if phones is None:
            return None
        frames = synthesize(visemes, phones, clip.num_frames, FRAME_RATE_HZ, clip.levels)
        return frames.astype(float)

    def next_phone(clip: RecognizedClip) -> Array:
        events = drop_first_hypotheses(clip.events[DEFAULT_DELAY_S])
        return live_frames(visemes, events, DEFAULT_DELAY_S, FRAME_RATE_HZ)

    def loudness(delay_s: float) -> Scheme:
        return Scheme("loudness", delay_s, lambda clip: loudness_frames(clip.clip.samples, delay_s))

    return [
        Scheme("aligned phones", None, lambda clip: full_frames(clip, clip.aligned)),
        Scheme("recognized phones", None, lambda clip: full_frames(clip, clip.recognized)),
        *(live_scheme(name, lips, d) for name, lips in lip_models.items() for d in DELAYS_S),
        Scheme("next phone", DEFAULT_DELAY_S, next_phone),
        *(loudness(delay_s) for delay_s in DELAYS_S),
        Scheme("mean mouth", None, still_mouth),
    ]


def live_scheme(name: str, lips: LipModel, delay_s: float) -> Scheme:
    """Return scheme 3 with a lip model and a delay."""
    return Scheme(
        name,
        delay_s,
        lambda clip: live_frames(lips, clip.events[delay_s], delay_s, FRAME_RATE_HZ),
    )


def live_frames(
    lips: LipModel, events: Sequence[SoundEvent], delay_s: float, frame_rate_hz: float
) -> Array:
    """Return frames (num_frames, 68) of the live chain, without idle motion."""
    face = FaceAnimator(lips, frame_rate_hz=frame_rate_hz, delay_s=delay_s)
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


def loudness_frames(samples: NDArray[np.float32], delay_s: float) -> Array:
    """Return frames (num_frames, 68) of a mouth that opens with the level, from 0 to 1 over 40 dB.

    The level is smoothed over what is known ``delay_s`` after the frame. The level of the loudest
    frames is known from the start, which favors this baseline.
    """
    hop = round(SAMPLE_RATE_HZ / FRAME_RATE_HZ)
    num_frames = len(samples) // hop + 1
    padded = np.pad(samples.astype(float), (hop, 2 * hop))
    power = [np.mean(padded[k * hop : (k + 2) * hop] ** 2) for k in range(num_frames)]
    level_db = 10.0 * np.log10(np.array(power) + 1e-10)
    loudest_db = np.percentile(level_db, 95)
    level = np.clip((level_db - loudest_db) / _LOUDNESS_RANGE_DB + 1.0, 0.0, 1.0)
    reach = len(_LOUDNESS_WINDOW) // 2
    ends_s = np.arange(1 - reach, reach + 2) / FRAME_RATE_HZ  # of the audio behind each level
    window = np.where(ends_s <= delay_s + 1e-9, _LOUDNESS_WINDOW, 0.0)
    level = np.correlate(np.pad(level, reach), window / window.sum(), mode="valid")
    faps = np.zeros((num_frames, NUM_FAPS))
    faps[:, 2], faps[:, 4] = 300.0 * level, -600.0 * level
    return faps


def still_mouth(clip: RecognizedClip) -> Array:
    """Return frames (num_frames, 68) of a half-open mouth that does not move."""
    faps = np.zeros((clip.num_frames, NUM_FAPS))
    faps[:, 4] = -_STILL_OPENING
    return faps


def is_speech(clip: RecognizedClip, time_s: Array) -> NDArray[np.bool_]:
    """Whether somebody speaks at the given times.

    The recognizer's voice activity is on, and a sound less than 30 dB below the loudest is within
    0.1 s. Voice activity alone spans pauses of half a second; the level alone takes noise for
    speech.
    """
    speech: NDArray[np.bool_] = _is_active(clip, time_s) & is_near(
        time_s, _loud_s(clip), _SPEECH_MARGIN_S
    )
    return speech


def _is_active(clip: RecognizedClip, time_s: Array) -> NDArray[np.bool_]:
    events = next(iter(clip.events.values()))  # voice activity is the same for all delays
    changes = [event for event in events if isinstance(event, SpeechChange)]
    after = np.searchsorted([change.time_s for change in changes], time_s, side="right")
    return np.array([False, *(change.active for change in changes)])[after]


def _loud_s(clip: RecognizedClip) -> Array:
    """Return when the sound is less than 30 dB below the loudest, seconds."""
    if not clip.levels:
        return np.zeros(0)
    end_s, level_db = np.array(clip.levels).T
    is_loud = level_db > np.percentile(level_db, 95) - _SPEECH_RANGE_DB
    loud_s: Array = end_s[is_loud] - LEVEL_STEP_S / 2.0
    return loud_s


def labials(clip: RecognizedClip) -> list[Phone]:
    """Return the phones that start with closed lips; none for a clip in another language."""
    if clip.clip.language != clip.inventory.code:
        return []
    visemes = clip.inventory.visemes
    phones = clip.aligned or clip.recognized
    return [phone for phone in phones if visemes[phone.symbol][0][0] == _LABIAL]


def quietest_moments(clip: LipClip, phones: Sequence[Phone]) -> Array:
    """Return when each phone of a clip is quietest, seconds."""
    hop = round(_POWER_STEP_S * SAMPLE_RATE_HZ)
    power = np.square(clip.samples[: len(clip.samples) // hop * hop], dtype=float)
    level = power.reshape(-1, hop).mean(axis=1)
    moments = []
    for phone in phones:
        first = round(phone.onset_s / _POWER_STEP_S)
        last = max(round((phone.onset_s + phone.duration_s) / _POWER_STEP_S), first + 1)
        if first < len(level):
            moments.append((first + int(np.argmin(level[first:last])) + 0.5) * _POWER_STEP_S)
    return np.array(moments)
