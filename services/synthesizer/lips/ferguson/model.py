"""Live Ferguson lips: syllable times from energy and zero crossings, mouth shapes from phones.

    level, zero crossings -> segments --+
                                        +-> key frames -> R(t) -> transition -> FAPs
    recognized phones ------------------+

Source: Zhang et al. 2021, sections 4 and 5. In the paper, the text is known; here, phones are
recognized. A recognized syllable starts with its segment, and the influence factor places its
final.

A segment is known before its phones. Until its phones are known, the mouth moves toward an average
syllable. Likewise, an average phone follows the last known phone. When segments or phones change,
a *transition* keeps the mouth continuous in position and velocity.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from kouxing.services.synthesizer.lips.ferguson.contour import opening_to_faps
from kouxing.services.synthesizer.lips.ferguson.key_frames import (
    OPENING_TIME_S,
    PAUSE_S,
    KeyFrames,
    build_anchors,
)
from kouxing.services.synthesizer.lips.ferguson.phone_table import MAX_OPENING, PhoneTable
from kouxing.services.synthesizer.lips.ferguson.syllable_segmenter import (
    EnergySegment,
    SyllableSegmenter,
)
from kouxing.services.synthesizer.lips.known_phones import RECOGNIZED_AFTER_S, KnownPhones
from kouxing.services.synthesizer.lips.lip_model import MouthFrame, SyllableArticulation
from kouxing.services.synthesizer.lips.trajectory import (
    NO_TRANSITION,
    SLOW_TRANSITION_S,
    TRANSITION_S,
    FapState,
    RestTransition,
    Transition,
    clip_state,
    stationary_state,
)
from kouxing.shared.face.faps import NUM_MOUTH_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

_SNAP_S = 0.06  # a syllable this close to the start of a segment starts with the segment
_EXPECTED_S = 0.15  # wait for an expected phone before the mouth closes
_CLOSING_S = 0.1
_MEMORY_S = 1.5
_REST_S = 0.15  # duration of the return to rest without sound
_DERIVATIVE_STEP_S = 1e-3


@dataclass(frozen=True, slots=True)
class AveragePhone:
    """The average of some phones."""

    opening: float  # R
    duration_s: float


@dataclass(frozen=True)
class FergusonLips:
    """The lip model of Zhang et al. 2021, for the phones of a language."""

    amplitude_applies: ClassVar[bool] = False

    table: PhoneTable
    inventory: PhoneInventory

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> FergusonStream:
        """Start a session at rest; see ``LipModel.stream``."""
        del frame_rate_hz
        return FergusonStream(self, start_s, delay_s=delay_s)

    @cached_property
    def average_initial(self) -> AveragePhone:
        """The average initial of the language."""
        return self._average(self.inventory.initials)

    @cached_property
    def average_vowel(self) -> AveragePhone:
        """The average vowel of the language."""
        return self._average(self.inventory.vowels)

    def _average(self, phones: Collection[str]) -> AveragePhone:
        in_order = sorted(phones)  # so that the rounding does not depend on the order of a set
        return AveragePhone(
            opening=float(np.mean([self.table.opening[phone] for phone in in_order])),
            duration_s=float(np.mean([self.table.duration_s[phone] for phone in in_order])),
        )


class FergusonStream:
    """A session of Ferguson lips; implements ``LipStream``."""

    def __init__(self, model: FergusonLips, start_s: float, *, delay_s: float) -> None:
        self._model = model
        self._delay_s = delay_s
        self._known = KnownPhones(model.inventory)
        self._segmenter = SyllableSegmenter()
        self._segments: list[EnergySegment] = []
        self._known_s = start_s  # the audio is known up to here
        self._has_ended = True  # whether speech has ended
        self._has_expected = False  # whether the key frames end with an expected phone
        self._key_frames = KeyFrames(np.zeros(1), np.zeros(1))
        self._transition = NO_TRANSITION
        self._pending_s: float | None = None  # duration of the transition for new events
        self._rest: RestTransition | None = None  # set while media time does not advance
        self._time_s = start_s  # time of the last frame
        self._mouth = stationary_state(np.zeros(NUM_MOUTH_FAPS))

    def add_event(self, event: SoundEvent) -> None:
        """Add the sound's progress, a phone, a revision, or a change of voice activity."""
        match event:
            case Progress():
                start_s = self._segmenter.start_s
                self._segments += self._segmenter.add_slice(event)
                self._known_s = event.time_s
                if self._segmenter.start_s != start_s:
                    self._request_transition(TRANSITION_S)
            case Phone():
                if self._known.add_phone(event):
                    self._has_ended = False
                    self._request_transition(TRANSITION_S)
            case SpeechChange():
                self._has_ended = not event.active
                if self._known.add_speech_change(event):
                    self._request_transition(SLOW_TRANSITION_S)

    def flush(self) -> None:
        """Drop the known events and return to rest within 150 ms."""
        self._known.flush()
        self._segmenter = SyllableSegmenter()
        self._segments.clear()
        self._has_ended = True
        self._rest = None
        self._request_transition(SLOW_TRANSITION_S)

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times increase."""
        if self._pending_s is not None:
            self._known.forget_before(self._time_s - _MEMORY_S)
            self._segments = [
                segment for segment in self._segments if segment.end_s >= self._time_s - _MEMORY_S
            ]
        phones = self._snap_phones()
        self._key_frames = self._make_key_frames(phones)
        if self._pending_s is not None or self._rest is not None:
            duration_s = SLOW_TRANSITION_S if self._rest is not None else self._pending_s
            difference = self._mouth - self._target_at(self._time_s)
            self._transition = Transition(
                difference, np.full(NUM_MOUTH_FAPS, duration_s), self._time_s
            )
            self._pending_s = self._rest = None
        self._mouth = _clip_to_limits(self._target_at(time_s) + self._transition.at(time_s))
        self._time_s = time_s
        return MouthFrame(self._mouth.value, self._articulation(phones))

    def relax(self, step_s: float) -> MouthFrame:
        """Return the mouth one step closer to rest."""
        if self._rest is None:
            self._rest = RestTransition(self._mouth, np.zeros(NUM_MOUTH_FAPS), _REST_S)
        self._mouth = _clip_to_limits(self._rest.step(step_s))
        return MouthFrame(self._mouth.value, self._articulation(self._snap_phones()))

    def _request_transition(self, duration_s: float) -> None:
        self._pending_s = max(self._pending_s or 0.0, duration_s)

    def _target_at(self, time_s: float) -> FapState:
        step_s = _DERIVATIVE_STEP_S
        times_s = np.array([time_s - step_s, time_s, time_s + step_s])
        before, here, after = opening_to_faps(self._key_frames.openings_at(times_s))
        return FapState(here, (after - before) / (2.0 * step_s))

    def _articulation(self, phones: Sequence[Phone]) -> SyllableArticulation:
        vowels = self._model.inventory.vowels
        return SyllableArticulation(
            np.array([phone.onset_s for phone in phones if phone.symbol in vowels])
        )

    def _snap_phones(self) -> list[Phone]:
        """Return the known phones, with syllables moved to the starts of their segments.

        While the end of the last phone is an estimate, it lasts as long as its segment.
        """
        inventory = self._model.inventory
        starts_s = np.array([segment.start_s for segment in self._segments])
        if self._segmenter.start_s is not None:
            starts_s = np.append(starts_s, self._segmenter.start_s)
        phones = self._known.sorted_by_onset()
        snapped: list[Phone] = []
        for number, phone in enumerate(phones):
            onset_s = phone.onset_s
            before = phones[number - 1].symbol if number else inventory.silence
            if before not in inventory.initials and len(starts_s):
                nearest_s = float(starts_s[np.abs(starts_s - onset_s).argmin()])
                if abs(nearest_s - onset_s) <= _SNAP_S:
                    onset_s = nearest_s
            if snapped:
                onset_s = max(onset_s, snapped[-1].onset_s)
            end_s = max(phone.end_s, onset_s)
            if number == len(phones) - 1 and not phone.final:
                end_s = max(end_s, self._sound_end_s)
            snapped.append(replace(phone, onset_s=onset_s, duration_s=end_s - onset_s))
        return snapped

    @property
    def _sound_end_s(self) -> float:
        """End of the last segment, as far as the audio is known."""
        if self._segmenter.start_s is not None:
            return self._known_s
        return self._segments[-1].end_s if self._segments else -np.inf

    def _make_key_frames(self, phones: Sequence[Phone]) -> KeyFrames:
        """Return the key frames of the known phones, followed by those of an expected phone."""
        opening = self._model.table.opening
        frames = [(time_s, opening[symbol]) for time_s, symbol in build_anchors(phones)]
        expected: list[tuple[float, float]] = []
        if not self._has_ended and not self._is_silent_after(phones):
            expected = self._expected_key_frames(frames, phones)
        if bool(expected) != self._has_expected:
            self._has_expected = bool(expected)
            self._request_transition(TRANSITION_S if expected else SLOW_TRANSITION_S)
        frames = _drop_unordered([*frames, *expected] or [(0.0, 0.0)])
        return KeyFrames(
            np.array([time_s for time_s, _ in frames]), np.array([r for _, r in frames])
        )

    def _is_silent_after(self, phones: Sequence[Phone]) -> bool:
        """Return whether the last phone's segment has ended, and no new segment has started."""
        if self._segmenter.start_s is not None or not self._segments:
            return False
        return not phones or phones[-1].onset_s < self._segments[-1].end_s

    def _expected_key_frames(
        self, frames: list[tuple[float, float]], phones: Sequence[Phone]
    ) -> list[tuple[float, float]]:
        """Return the key frames of an average phone after the last one, or of a new segment.

        They replace the closing of the mouth, which is removed from ``frames``.
        """
        initial, vowel = self._model.average_initial, self._model.average_vowel
        start_s = self._segmenter.start_s
        expected: list[tuple[float, float]] = []
        is_new = (
            start_s is not None
            and self._known_s < start_s + _EXPECTED_S
            and (not phones or start_s > phones[-1].onset_s + _SNAP_S)
        )
        if is_new and start_s is not None:
            next_s, next_opening = start_s + initial.duration_s, vowel.opening
            if frames and start_s - frames[-1][0] < PAUSE_S:
                frames.pop()
            else:
                expected.append((start_s - OPENING_TIME_S, 0.0))
            expected.append((start_s, initial.opening))
        elif frames and self._known_s < frames[-1][0] + _EXPECTED_S:
            next_s = frames.pop()[0]
            is_after_initial = phones[-1].symbol in self._model.inventory.initials
            next_opening = vowel.opening if is_after_initial else initial.opening
        else:
            return []
        closed_s = next_s + _EXPECTED_S
        next_s = min(max(next_s, self._known_s - RECOGNIZED_AFTER_S), closed_s - _CLOSING_S)
        return [*expected, (next_s, next_opening), (closed_s, 0.0)]


def _drop_unordered(frames: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Drop key frames that are not later than their predecessor."""
    rising = [frames[0]]
    for frame in frames[1:]:
        if frame[0] > rising[-1][0]:
            rising.append(frame)
    return rising


def _clip_to_limits(state: FapState) -> FapState:
    widest = opening_to_faps([MAX_OPENING])[0]
    return clip_state(state, np.minimum(widest, 0.0), np.maximum(widest, 0.0))
