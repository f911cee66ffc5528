"""Two networks on the same frames: a causal one is early, another is late and knows better.

The late one's scores are settled, or provisional where it has less sound after a frame than it
will have. For the newest frames, which it has not heard yet, the causal network's scores stand in.
So a phone is told as soon as the causal network knows it, and corrected by the other. Lips from
sound follow the causal network's positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticStream,
    OnPosition,
    Topology,
    Work,
    no_scores,
)
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.network import Floats
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.phones.inventory import PhoneInventory


@dataclass(frozen=True)
class TwoNetworks:
    """Both models, with the same states; implements ``AcousticModel``."""

    early: NeuralModel
    late: BlockModel

    @property
    def topology(self) -> Topology:
        """The HMMs whose states are scored."""
        return self.late.topology

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.late.inventory

    def front_end(self) -> WhisperMel:
        """Start a front end for one session."""
        return self.late.front_end()

    def stream(self) -> TwoNetworksStream:
        """Start a stream of scores and positions for one speaker."""
        return TwoNetworksStream(self)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams; None ends a stream's segment."""
        streams = [(cast(TwoNetworksStream, stream), frames) for stream, frames in work]
        newest = self.early.score([(stream.early, frames) for stream, frames in streams])
        settled = self.late.score([(stream.late, frames) for stream, frames in streams])
        for (stream, frames), *scores in zip(streams, newest, settled, strict=True):
            stream.take_scores(*scores, is_end=frames is None)
        return settled


class TwoNetworksStream:
    """Scores and positions of one speaker's speech, segment by segment."""

    def __init__(self, model: TwoNetworks) -> None:
        self._model = model
        self.early = model.early.stream()
        self.late: AcousticStream = model.late.stream()
        self.look_ahead_frames = self.late.look_ahead_frames
        self._no_scores = no_scores(model.topology.num_states)
        self.reset()

    @property
    def on_position(self) -> OnPosition | None:
        """Is called for every position of the causal network, in order; None: nobody asks."""
        return self.early.on_position

    @on_position.setter
    def on_position(self, called: OnPosition | None) -> None:
        self.early.on_position = called

    def accept(self, frames: Floats) -> Floats:
        """Take frames, shape (n, 80); return the scores settled, (m, states)."""
        return self._model.score([(self, frames)])[0]

    def finish(self) -> Floats:
        """End the segment; return its remaining scores."""
        return self._model.score([(self, None)])[0]

    def reset(self) -> None:
        """Forget the segment."""
        self.early.reset()
        self.late.reset()
        self._stand_in = self.provisional = self._no_scores

    def take_scores(self, newest: Floats, settled: Floats, *, is_end: bool) -> None:
        """Take the scores of both networks, (m, states) each; the late one settles frames."""
        if is_end:
            self.reset()
            return
        if len(newest) or len(settled):
            self._stand_in = np.concatenate([self._stand_in, newest])[len(settled) :]
            known = self.late.provisional
            self.provisional = np.concatenate([known, self._stand_in[len(known) :]])
