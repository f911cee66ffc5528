"""Ferguson lips live: energy and zero crossings give the syllables' times, phones their shapes.

    level, zero crossings -> pieces --+
                                      +-> key frames -> R(t) -> transition -> FAPs
    recognised phones ----------------+

Source: Zhang et al. 2021, sections 4 and 5, without its text: where a piece of the sound begins,
the syllable that is recognised there begins, and its final follows by the influence factor.

A piece is known before its phones are: until then the mouth sets out for a middling syllable. The
last phone known is followed by what is usual, in the same way. Where the pieces or the phones
change, a *transition* keeps the mouth continuous in position and velocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.known_phones import KnownPhones
from kouxing.services.synthesizer.lips.dynamic_visemes.trajectory import (
    NO_TRANSITION,
    Motion,
    Rest,
    Transition,
    motionless,
)
from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.services.synthesizer.lips.ferguson.endpoints import Piece, SyllableCutter
from kouxing.services.synthesizer.lips.ferguson.motion import KeyFrames
from kouxing.services.synthesizer.lips.ferguson.openings import PAUSE_S, SETTING_OUT_S, anchors_of
from kouxing.services.synthesizer.lips.ferguson.table import PhoneTable
from kouxing.services.synthesizer.lips.lip_model import MouthFrame
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_SNAP_S = 0.06  # a syllable this near to the beginning of a piece begins with it
_RECOGNISED_AFTER_S = 0.09  # most phones are recognised within this time after their onset
_EXPECTED_S = 0.15  # how long the mouth waits for what usually follows, before it closes
_CLOSING_S = 0.1
_MEMORY_S = 1.5
_TRANSITION_S = 0.04  # from one course of the mouth to the next
_SLOW_TRANSITION_S = 0.14  # to rest after an interruption, and back from rest
_REST_S = 0.15  # to rest when no sound comes
_SLOPE_STEP_S = 1e-3


@dataclass(frozen=True)
class FergusonLips:
    """Lips of one opening, for the phones of a language."""

    amplitude_applies: ClassVar[bool] = False

    table: PhoneTable
    inventory: PhoneInventory

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> FergusonStream:
        """Start a session at rest, as ``LipModel.stream``."""
        del frame_rate_hz
        return FergusonStream(self, start_s, delay_s=delay_s)

    @cached_property
    def usual(self) -> dict[bool, tuple[float, float]]:
        """Mean opening and length, seconds, of initials (True) and vowels (False)."""
        kinds = {True: sorted(self.inventory.initials), False: sorted(self.inventory.vowels)}
        return {
            is_initial: (
                float(np.mean([self.table.opening[phone] for phone in phones])),
                float(np.mean([self.table.duration_s[phone] for phone in phones])),
            )
            for is_initial, phones in kinds.items()
        }


@dataclass(frozen=True, slots=True)
class Syllables:
    """What is being said, as far as this lip model knows; implements ``Articulation``."""

    syllable_onsets_s: Array

    def usual_level_db(self, time_s: float) -> float | None:
        """Return None: it is not known."""
        del time_s
        return None


class FergusonStream:
    """One session of ferguson lips; implements ``LipStream``."""

    def __init__(self, model: FergusonLips, start_s: float, *, delay_s: float) -> None:
        self._model = model
        self._delay_s = delay_s
        self._known = KnownPhones(model.inventory)
        self._cutter = SyllableCutter()
        self._pieces: list[Piece] = []
        self._heard_s = start_s  # the sound is known up to here
        self._has_ended = True  # nobody speaks
        self._expects = False  # the course goes on with what is usual
        self._course = KeyFrames(np.zeros(1), np.zeros(1))
        self._transition, self._transition_start_s = NO_TRANSITION, start_s
        self._pending_s: float | None = None  # duration of the transition that new events ask for
        self._rest: Rest | None = None  # while media time stands still
        self._time_s = start_s  # of the last frame
        self._mouth = motionless(np.zeros(len(MOUTH_FAPS)))

    def accept(self, event: SoundEvent) -> None:
        """Take the sound's progress, a phone, a revision, or a change of voice activity."""
        match event:
            case Progress():
                self._accept_progress(event)
            case Phone():
                if self._known.accept_phone(event):
                    self._has_ended = False
                    self._lead(_TRANSITION_S)
            case SpeechChange():
                self._has_ended = not event.active
                if self._known.accept_speech(event):
                    self._lead(_SLOW_TRANSITION_S)

    def _accept_progress(self, event: Progress) -> None:
        begun_s = self._cutter.start_s
        self._pieces += self._cutter.accept(event)
        self._heard_s = event.time_s
        if self._cutter.start_s != begun_s:
            self._lead(_TRANSITION_S)

    def flush(self) -> None:
        """Drop what is known and return to rest within 150 ms."""
        self._known.flush()
        self._cutter = SyllableCutter()
        self._pieces.clear()
        self._has_ended = True
        self._rest = None
        self._lead(_SLOW_TRANSITION_S)

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, seconds; times rise."""
        if self._pending_s is not None:
            self._known.forget_before(self._time_s - _MEMORY_S)
            self._pieces = [
                piece for piece in self._pieces if piece.end_s >= self._time_s - _MEMORY_S
            ]
        phones = self._snapped_phones()
        self._course = self._key_frames(phones)
        if self._pending_s is not None or self._rest is not None:
            asked_s = _SLOW_TRANSITION_S if self._rest is not None else self._pending_s
            self._transition = Transition(
                self._mouth - self._course_at(self._time_s),
                np.full(len(MOUTH_FAPS), asked_s),
            )
            self._transition_start_s = self._time_s
            self._pending_s = self._rest = None
        left = self._transition.at(time_s - self._transition_start_s)
        self._mouth = _within_lips(self._course_at(time_s) + left)
        self._time_s = time_s
        return MouthFrame(self._mouth.value, self._syllables(phones))

    def relax(self, step_s: float) -> MouthFrame:
        """Lead the mouth to rest by one more step; media time stands still."""
        if self._rest is None:
            self._rest = Rest(self._mouth, np.zeros(len(MOUTH_FAPS)), _REST_S)
        self._mouth = _within_lips(self._rest.step(step_s))
        return MouthFrame(self._mouth.value, self._syllables(self._snapped_phones()))

    def _lead(self, duration_s: float) -> None:
        self._pending_s = max(self._pending_s or 0.0, duration_s)

    def _course_at(self, time_s: float) -> Motion:
        step_s = _SLOPE_STEP_S
        times_s = np.array([time_s - step_s, time_s, time_s + step_s])
        before, here, after = faps_of(self._course.openings_at(times_s))
        return Motion(here, (after - before) / (2.0 * step_s))

    def _syllables(self, phones: Sequence[Phone]) -> Syllables:
        vowels = self._model.inventory.vowels
        return Syllables(np.array([one.onset_s for one in phones if one.symbol in vowels]))

    def _snapped_phones(self) -> list[Phone]:
        """Return the phones known, those that begin a syllable at the beginning of its piece.

        The last one, while its end is an estimate, lasts as long as its piece.
        """
        inventory = self._model.inventory
        starts_s = np.array([piece.start_s for piece in self._pieces])
        if self._cutter.start_s is not None:
            starts_s = np.append(starts_s, self._cutter.start_s)
        phones = self._known.in_order()
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
            end_s = max(phone.onset_s + phone.duration_s, onset_s)
            if number == len(phones) - 1 and not phone.final:
                end_s = max(end_s, self._sound_end_s)
            snapped.append(replace(phone, onset_s=onset_s, duration_s=end_s - onset_s))
        return snapped

    @property
    def _sound_end_s(self) -> float:
        """When the last piece ends, as far as the sound is known."""
        if self._cutter.start_s is not None:
            return self._heard_s
        return self._pieces[-1].end_s if self._pieces else -np.inf

    def _key_frames(self, phones: Sequence[Phone]) -> KeyFrames:
        """Return the course of the mouth as far as the sound tells, and what is usual after it."""
        silence, opening = self._model.inventory.silence, self._model.table.opening
        frames = [(time_s, opening[symbol]) for time_s, symbol in anchors_of(phones, silence)]
        if not self._has_ended and not self._is_silent_after(phones):
            expected = self._expected(frames, phones)
            self._expect(bool(expected))
            frames += expected
        else:
            self._expect(False)
        frames = _rising(frames or [(0.0, 0.0)])
        return KeyFrames(
            np.array([time_s for time_s, _ in frames]), np.array([r for _, r in frames])
        )

    def _expect(self, expects: bool) -> None:
        if expects != self._expects:
            self._expects = expects
            self._lead(_TRANSITION_S if expects else _SLOW_TRANSITION_S)

    def _is_silent_after(self, phones: Sequence[Phone]) -> bool:
        """Whether the energy tells that the last phone has ended, and nothing has begun."""
        if self._cutter.start_s is not None or not self._pieces:
            return False
        return not phones or phones[-1].onset_s < self._pieces[-1].end_s

    def _expected(
        self, frames: list[tuple[float, float]], phones: Sequence[Phone]
    ) -> list[tuple[float, float]]:
        """Return what follows the last phone as a rule, or a piece whose phones are not known yet.

        The mouth closes if nothing comes; the closing after the last phone is taken back.
        """
        usual = self._model.usual
        begun_s = self._cutter.start_s
        expected: list[tuple[float, float]] = []
        is_new = (
            begun_s is not None
            and self._heard_s < begun_s + _EXPECTED_S
            and (not phones or begun_s > phones[-1].onset_s + _SNAP_S)
        )
        if is_new and begun_s is not None:
            opening, length_s = usual[True]
            next_s, next_opening = begun_s + length_s, usual[False][0]
            if frames and begun_s - frames[-1][0] < PAUSE_S:
                frames.pop()
            else:
                expected.append((begun_s - SETTING_OUT_S, 0.0))
            expected.append((begun_s, opening))
        elif frames and self._heard_s < frames[-1][0] + _EXPECTED_S:
            next_s = frames.pop()[0]
            next_opening = usual[phones[-1].symbol not in self._model.inventory.initials][0]
        else:
            return []
        given_up_s = next_s + _EXPECTED_S
        next_s = min(max(next_s, self._heard_s - _RECOGNISED_AFTER_S), given_up_s - _CLOSING_S)
        return [*expected, (next_s, next_opening), (given_up_s, 0.0)]


def _rising(frames: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Leave out key frames that do not come after the one before."""
    rising = [frames[0]]
    for frame in frames[1:]:
        if frame[0] > rising[-1][0]:
            rising.append(frame)
    return rising


def _within_lips(motion: Motion) -> Motion:
    widest = faps_of([5.0])[0]
    value = np.clip(motion.value, np.minimum(widest, 0.0), np.maximum(widest, 0.0))
    return Motion(value, np.where(value == motion.value, motion.slope, 0.0))
