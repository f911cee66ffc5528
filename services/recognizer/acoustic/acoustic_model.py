"""What the search needs from an acoustic model, Gaussian or neural."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.phones.inventory import PhoneInventory

# Position of a phone between two pauses. The last phone is lengthened; a single one counts as last.
FIRST, INSIDE, LAST = range(3)
NUM_POSITIONS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Topology:
    """One left-to-right HMM without skips per phone, joined in a loop.

    Source: Li et al. 2011, section 3.1.
    """

    phone_lm: PhoneLanguageModel
    first_state: NDArray[np.int64]  # (phones + 1,) phone p has states first_state[p] to [p + 1]
    log_stay: NDArray[np.float32]  # (states,) log-probability of staying in a state
    log_leave: NDArray[np.float32]  # (states,) log-probability of leaving it
    lm_scale: float = 1.0  # weight of the phone language model's log-probabilities
    phone_penalty: float = 0.0  # added to the log score at every phone
    duration_mean_s: NDArray[np.float32]  # (3, phones) mean by position and phone, seconds
    duration_spread_s: NDArray[np.float32]  # (3, phones) standard deviation, seconds

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.phone_lm.inventory

    @property
    def num_states(self) -> int:
        """Number of states of all phones."""
        return int(self.first_state[-1])


class FrontEnd(Protocol):
    """One session's features. Any chunking of the sound gives the same frames.

    Frame ``t`` covers the samples ``160 t`` to ``160 t + 400`` and is ready with the last of them.
    """

    def accept_waveform(self, samples: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take samples, shape (n,), 16 kHz, in [-1, 1]; return the new frames, (m, k)."""


class AcousticStream(Protocol):
    """State scores of one speaker's speech, segment by segment.

    Scores that are returned are settled: each frame has them once. A stream may tell more, of the
    frames that follow: provisional scores, made with less sound after the frame than it will have.
    """

    look_ahead_frames: int  # a frame's settled scores come at most this many frames after it

    @property
    def provisional(self) -> NDArray[np.float32]:
        """Of the frames after the settled ones, (k, states); a new array when they change."""

    def accept(self, frames: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take the front end's frames, shape (n, k); return the scores settled, (m, states)."""

    def finish(self) -> NDArray[np.float32]:
        """End the segment; return its remaining scores, (m, states)."""

    def reset(self) -> None:
        """Forget the segment and the speaker."""


def no_scores(num_states: int) -> NDArray[np.float32]:
    """Return the scores of no frames, (0, states)."""
    return np.empty((0, num_states), np.float32)


# Is told of a position: its two newest frames, (2, 80), and its values, (layers, heads, size).
OnPosition: TypeAlias = Callable[[NDArray[np.float32], NDArray[np.float32]], None]


@runtime_checkable
class PositionStream(AcousticStream, Protocol):
    """A stream whose network's positions may be heard as they come."""

    on_position: OnPosition | None  # is called for every position, in order; None: nobody asks


# A stream with the front end's next frames, (n, k), or None at the end of a segment.
Work: TypeAlias = tuple[AcousticStream, NDArray[np.float32] | None]
# Yields work, is sent its scores, and finally returns a result.
T = TypeVar("T")
ScoringTask: TypeAlias = Generator[Work, NDArray[np.float32], T]


class AcousticModel(Protocol):
    """A trained model, shared by any number of streams."""

    @property
    def topology(self) -> Topology:
        """The HMMs whose states are scored."""

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""

    def front_end(self) -> FrontEnd:
        """Start a front end for one session, at the beginning of its sound."""

    def stream(self) -> AcousticStream:
        """Start a stream of scores for one speaker."""

    def score(self, work: Sequence[Work]) -> list[NDArray[np.float32]]:
        """Score the work of several streams in one batch; each gets the scores it gets alone."""


def run_scoring_tasks(model: AcousticModel, tasks: Sequence[ScoringTask[T]]) -> list[T]:
    """Run the tasks of several sessions side by side, so that the model scores them in batches.

    Parameters
    ----------
    model
        The model of all their streams.
    tasks
        One for each session.

    Returns
    -------
    list
        The tasks' results, in their order.
    """
    results: dict[int, T] = {}
    scores: list[NDArray[np.float32] | None] = [None] * len(tasks)
    running = list(range(len(tasks)))
    while running:
        work: list[Work] = []
        still_running = []
        for number in running:
            try:
                rows = scores[number]
                work.append(next(tasks[number]) if rows is None else tasks[number].send(rows))
            except StopIteration as end:
                results[number] = end.value
            else:
                still_running.append(number)
        running = still_running
        for number, rows in zip(running, model.score(work) if work else [], strict=True):
            scores[number] = rows
    return [results[number] for number in range(len(tasks))]
