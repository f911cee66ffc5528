"""What the decoder needs of an acoustic model, Gaussian or neural."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Topology:
    """Left-to-right HMMs without skips, one per unit, joined in a loop.

    Source: Li et al. 2011, section 3.1.
    """

    first_state: NDArray[np.int64]  # (61,) unit u has the states first_state[u] to [u + 1]
    log_stay: NDArray[np.float32]  # (states,) log probability of a state's loop
    log_leave: NDArray[np.float32]  # (states,) log probability of going on
    log_bigram: NDArray[np.float32]  # (60, 60) score of unit (column) after unit (row)
    duration_mean_s: NDArray[np.float32]  # (60,) of each unit in the corpus, seconds
    duration_spread_s: NDArray[np.float32]  # (60,) standard deviation, seconds

    @property
    def num_states(self) -> int:
        """Number of states of all units."""
        return int(self.first_state[-1])


class AcousticStream(Protocol):
    """State scores of one speaker's speech, segment by segment."""

    look_ahead_frames: int  # a frame's scores come this many frames after it

    def accept(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take log-mel frames, shape (n, 41); return the scores ready, (m, states)."""

    def finish(self) -> NDArray[np.float32]:
        """End the segment and return the scores still owed."""

    def reset(self) -> None:
        """Forget the segment and the speaker."""


class AcousticModel(Protocol):
    """A trained model that any number of streams share."""

    @property
    def topology(self) -> Topology:
        """The HMMs that the scores belong to."""

    def stream(self) -> AcousticStream:
        """Start a stream of scores for one speaker."""
