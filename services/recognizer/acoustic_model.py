"""What the decoder needs of an acoustic model, Gaussian or neural."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from services.recognizer.unit_language import UnitLanguage

# Where a unit stands between two pauses; the last one is lengthened. One alone counts as last.
FIRST, INSIDE, LAST = range(3)
NUM_POSITIONS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Topology:
    """Left-to-right HMMs without skips, one per unit, joined in a loop.

    Source: Li et al. 2011, section 3.1.
    """

    first_state: NDArray[np.int64]  # (61,) unit u has the states first_state[u] to [u + 1]
    log_stay: NDArray[np.float32]  # (states,) log probability of a state's loop
    log_leave: NDArray[np.float32]  # (states,) log probability of going on
    language: UnitLanguage  # what follows what
    language_scale: float = 1.0  # of its log shares
    unit_penalty: float = 0.0  # added for every unit
    duration_mean_s: NDArray[np.float32]  # (3, 60) of each unit by position, seconds
    duration_spread_s: NDArray[np.float32]  # (3, 60) standard deviation, seconds

    @property
    def num_states(self) -> int:
        """Number of states of all units."""
        return int(self.first_state[-1])


class FrontEnd(Protocol):
    """The features that a model hears, of one session's sound; any chunking gives the same.

    Frame ``t`` is of the samples ``160 t`` to ``160 t + 400`` and is ready with the last of them.
    """

    def accept_waveform(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take samples, shape (n,), 16 kHz, in [-1, 1]; return the new frames, (m, k)."""


class AcousticStream(Protocol):
    """State scores of one speaker's speech, segment by segment."""

    look_ahead_frames: int  # a frame's scores come this many frames after it, or sooner

    def accept(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take the front end's frames, shape (n, k); return the scores ready, (m, states)."""

    def finish(self) -> NDArray[np.float32]:
        """End the segment and return the scores still owed."""

    def reset(self) -> None:
        """Forget the segment and the speaker."""


# A stream with the front end's frames for it, (n, k), or with None at the end of a segment.
Work: TypeAlias = tuple[AcousticStream, NDArray[np.float32] | None]
# What hands out work, is sent the scores, and returns a result in the end.
T = TypeVar("T")
Listening: TypeAlias = Generator[Work, NDArray[np.float32], T]


class AcousticModel(Protocol):
    """A trained model that any number of streams share."""

    @property
    def topology(self) -> Topology:
        """The HMMs that the scores belong to."""

    def front_end(self) -> FrontEnd:
        """Start a front end for one session; a new one stands at the beginning of the sound."""

    def stream(self) -> AcousticStream:
        """Start a stream of scores for one speaker."""

    def score(self, work: Sequence[Work]) -> list[NDArray[np.float32]]:
        """Score the work of different streams together; the scores are those of each alone."""


def listen(model: AcousticModel, listenings: Sequence[Listening[T]]) -> list[T]:
    """Let sessions listen side by side, so that the model scores their frames together.

    Parameters
    ----------
    model
        The model of all their streams.
    listenings
        One for each session.

    Returns
    -------
    list
        What each of them returns.
    """
    results: dict[int, T] = {}
    scores: list[NDArray[np.float32] | None] = [None] * len(listenings)
    going = list(range(len(listenings)))
    while going:
        work: list[Work] = []
        still = []
        for number in going:
            try:
                given = scores[number]
                work.append(
                    next(listenings[number]) if given is None else listenings[number].send(given)
                )
            except StopIteration as end:
                results[number] = end.value
            else:
                still.append(number)
        going = still
        for number, rows in zip(going, model.score(work) if work else [], strict=True):
            scores[number] = rows
    return [results[number] for number in range(len(listenings))]
