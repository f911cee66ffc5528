"""The interface of acoustic models, Gaussian mixtures and networks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.arrays import Floats, Integers
from kouxing.shared.phones.inventory import PhoneInventory

# Place of a phone between two pauses. The phone before a pause is lengthened; a single
# phone counts as BEFORE_PAUSE.
AFTER_PAUSE, WITHIN_PHRASE, BEFORE_PAUSE = range(3)
NUM_PHRASE_POSITIONS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Topology:
    """One left-to-right HMM without skips per phone, joined in a loop.

    Source: Li et al. 2011, section 3.1.
    """

    phone_lm: PhoneLanguageModel
    first_state: Integers  # (phones + 1,) phone p has states first_state[p] to [p + 1]
    log_stay: Floats  # (states,) log-probability of staying in a state
    log_leave: Floats  # (states,) log-probability of leaving it
    lm_scale: float = 1.0  # weight of the phone language model's log-probabilities
    phone_penalty: float = 0.0  # added to the log score at every phone
    rate_weight: float = 0.0  # dependence of the phone penalty on the speaking rate; see Decoder
    duration_mean_s: Floats  # (3, phones) mean by position and phone, seconds
    duration_spread_s: Floats  # (3, phones) standard deviation, seconds

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.phone_lm.inventory

    @property
    def num_states(self) -> int:
        """Number of states of all phones."""
        return int(self.first_state[-1])


class FrontEnd(Protocol):
    """One session's features. Any chunking of the audio gives the same frames.

    Frame ``t`` covers the samples ``160 t`` to ``160 t + 400`` and is ready with the last of them.
    """

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept samples, shape (n,), 16 kHz, in [-1, 1]; return the new frames, (m, k)."""


class AcousticStream(ABC):
    """State scores of one speaker's speech, segment by segment.

    The returned scores are settled: they never change. A stream may also have provisional scores
    of the next frames, computed from less audio.
    """

    # whether it scores the encoder's phones instead of the front end's frames
    uses_encoder_phones = False
    look_ahead_frames: int  # maximum delay of a frame's settled scores, frames
    provisional: Floats  # (k, states) of the next frames; replaced by a new array when it changes

    def __init__(self, model: AcousticModel) -> None:
        self.model = model
        self.provisional = empty_scores(model.topology.num_states)

    def score(self, frames: Floats | None) -> Floats:
        """Score the front end's frames, (n, k), without other streams; None ends the segment.

        Returns the newly settled scores, (m, states).
        """
        return self.model.score([(self, frames)])[0]

    @abstractmethod
    def reset(self) -> None:
        """Reset the state of the segment and the speaker."""


def empty_scores(num_states: int) -> Floats:
    """Return the scores of no frames, (0, states)."""
    return np.empty((0, num_states), np.float32)


# A stream and the front end's next frames, (n, k), or None at the end of a segment.
ScoreRequest: TypeAlias = tuple[AcousticStream, Floats | None]


@dataclass(frozen=True, kw_only=True)
class AcousticModel(ABC):
    """A trained model, shared by any number of streams."""

    topology: Topology  # the HMMs whose states are scored

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.topology.inventory

    @abstractmethod
    def create_front_end(self) -> FrontEnd:
        """Create the front end of one session."""

    @abstractmethod
    def create_stream(self) -> AcousticStream:
        """Create the stream of one speaker."""

    @abstractmethod
    def score(self, requests: Sequence[ScoreRequest]) -> list[Floats]:
        """Score several streams in one batch. The scores do not depend on the batch."""


def score_segment(model: AcousticModel, frames: Floats) -> Floats:
    """Score a whole segment, (frames, k) to (frames, states)."""
    stream = model.create_stream()
    return np.concatenate([stream.score(frames), stream.score(None)])
