"""The interface of modifiers, which change a FAP frame after the lip model has set the mouth."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Protocol

from kouxing.services.synthesizer.lips.lip_model import Articulation
from kouxing.shared.arrays import Floats
from kouxing.shared.fast_record import Record


class FrameContext(Record, frozen=True, kw_only=True):
    """Information about a frame for modifiers."""

    time_s: float  # media time of the frame
    known_s: float  # media time up to which the audio is known
    elapsed_s: float  # since the first frame; continues while media time does not advance
    step_s: float  # since the previous frame
    is_speaking: bool  # speech is active or known to start very soon
    levels: Sequence[tuple[float, float]]  # new levels, finite: media time s, level dB
    articulation: Articulation
    pitches: Sequence[tuple[float, float]] = ()  # new pitches: media time s, Hz
    feeling: tuple[float, float] = (0.0, 0.0)  # arousal and valence of the voice, -1 to 1
    is_laughter: bool = False
    is_breath: bool = False
    amplitude_applies: bool = True  # False if the lip model already follows the level


class Modifier(Protocol):
    """Changes the frames of one session; may have state."""

    def apply(self, faps: Floats, context: FrameContext) -> None:
        """Change a frame, FAPs (68,) in FAP units, in place."""


def pop_until(values: deque[tuple[float, float]], until_s: float) -> Iterator[tuple[float, float]]:
    """Remove and yield the values up to a media time."""
    while values and values[0][0] <= until_s:
        yield values.popleft()
