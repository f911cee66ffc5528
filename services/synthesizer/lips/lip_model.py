"""What every lip model offers: mouth FAPs from what is known of the speech so far.

A model is loaded once and shared by all sessions; each session has a stream of its own. A new kind
of lips is a package beside ``dynamic_visemes``, a ``LipModelName`` and an entry in
``load.LIP_MODELS``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.phones.events import SoundEvent


class Articulation(Protocol):
    """What is being said, as far as the lip model knows: modifiers ask for it."""

    @property
    def syllable_onsets_s(self) -> NDArray[np.float64]:
        """When each syllable's vowel begins, shape (num_syllables,), rising; media time."""

    def usual_level_db(self, time_s: float) -> float | None:
        """Level, relative to the speaker's mean, of what is said at a time; None if unknown."""


@dataclass(frozen=True, slots=True)
class MouthFrame:
    """The mouth at one time."""

    faps: NDArray[np.float64]  # (num_mouth_faps,) FAP units, in the order of MOUTH_FAPS
    articulation: Articulation


class LipStream(Protocol):
    """One session's lips. Frame times rise."""

    def accept(self, event: SoundEvent) -> None:
        """Take an event. Those that this kind of lips does not use are ignored."""

    def frame_at(self, time_s: float) -> MouthFrame:
        """Return the mouth at a media time from all events up to the delay after it."""

    def relax(self, step_s: float) -> MouthFrame:
        """Lead the mouth to rest, by one more step, while media time stands still."""

    def flush(self) -> None:
        """Drop what is known (an interruption); the frames to come lead to rest."""


class LipModel(Protocol):
    """Lips that any number of sessions share.

    Attributes
    ----------
    amplitude_applies
        Whether the openings are still to be scaled with the level of the voice.
    """

    amplitude_applies: ClassVar[bool]

    def stream(self, start_s: float, *, frame_rate_hz: float, delay_s: float) -> LipStream:
        """Start a session at rest.

        Parameters
        ----------
        start_s
            Media time of the first frame.
        frame_rate_hz
            Frames per second of media time.
        delay_s
            How much sound after a frame is known when the frame is made.
        """
