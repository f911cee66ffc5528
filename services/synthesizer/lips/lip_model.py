"""The interface of lip models, which compute mouth FAPs from sound events.

A lip model is loaded once and shared by all sessions; each session has its own stream. To add a lip
model, add a package like ``dynamic_visemes`` whose ``__init__`` defines ``LIP_MODEL``, see
``services.lip_models``.
"""

from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from kouxing.shared.arrays import Doubles
from kouxing.shared.fast_record import Record
from kouxing.shared.phones.events import SoundEvent


class Articulation(Protocol):
    """Data about the current speech for modifiers."""

    @property
    def syllable_onsets_s(self) -> Doubles:
        """Media time of each syllable's vowel onset, shape (num_syllables,), ascending."""

    def usual_level_db(self, time_s: float) -> float | None:
        """Return the usual level of the speech at a time, relative to the speaker's mean."""


@dataclass(frozen=True, slots=True)
class SyllableArticulation:
    """Syllable onsets without usual levels; implements ``Articulation``."""

    syllable_onsets_s: Doubles

    def usual_level_db(self, time_s: float) -> float | None:
        """Return None (unknown)."""
        del time_s
        return None


class MouthFrame(Record, frozen=True):
    """The mouth at one time."""

    faps: Doubles  # (num_mouth_faps,) FAP units, in the order of MOUTH_FAPS
    articulation: Articulation = SyllableArticulation(np.zeros(0))  # unknown


class LipStream(Protocol):
    """The lips of one session. Frame times increase."""

    def add_event(self, event: SoundEvent) -> None:
        """Add an event; events that the lip model does not use are ignored."""

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time, given all events up to the delay after it."""

    def relax(self, step_s: float) -> MouthFrame:
        """Return the mouth one step closer to rest while media time does not advance."""

    def flush(self) -> None:
        """Drop the known events (an interruption); the next frames return to rest."""


@runtime_checkable
class LipModel(Protocol):
    """A lip model, shared by any number of sessions."""

    amplitude_applies: ClassVar[bool]  # whether openings may be scaled with the level of the voice

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> LipStream:
        """Start a session at rest, with the first frame at media time ``start_s``.

        ``delay_s`` is how much audio after a frame is known when the frame is made.
        """
