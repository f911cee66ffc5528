"""Two networks on the same frames: a causal one answers early, a block network answers better.

The block network's scores are settled, or provisional where it has less audio after a frame than it
will have. The newest frames have not reached it yet: their provisional scores are the causal
network's. So a phone is emitted as soon as the causal network detects it, and the block network
corrects it. The lip predictor uses the causal network's positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    Floats,
    Work,
)
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel


@dataclass(frozen=True, kw_only=True)
class TwoNetworks(AcousticModel):
    """Both models, with the same states."""

    early: NeuralModel
    late: BlockModel

    def create_front_end(self) -> WhisperMel:
        """Create the front end of one session."""
        return self.late.create_front_end()

    def create_stream(self, *, keep_positions: bool = False) -> TwoNetworksStream:
        """Create the stream of one speaker, with the causal network's positions if kept."""
        return TwoNetworksStream(self, keep_positions=keep_positions)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams; None ends a stream's segment."""
        streams = [(cast(TwoNetworksStream, stream), frames) for stream, frames in work]
        early = self.early.score([(stream.early, frames) for stream, frames in streams])
        settled = self.late.score([(stream.late, frames) for stream, frames in streams])
        for (stream, frames), *scores in zip(streams, early, settled, strict=True):
            stream.update_provisional(*scores, is_end=frames is None)
        return settled


class TwoNetworksStream(AcousticStream):
    """Scores and positions of one speaker's speech, segment by segment."""

    def __init__(self, model: TwoNetworks, *, keep_positions: bool) -> None:
        super().__init__(model)
        self.early = model.early.create_stream(keep_positions=keep_positions)
        self.late = model.late.create_stream()
        self.positions = self.early.positions
        self.look_ahead_frames = self.late.look_ahead_frames
        self._empty_scores = self.provisional
        self.reset()

    def reset(self) -> None:
        """Forget the segment."""
        self.early.reset()
        self.late.reset()
        self._early_scores = self.provisional = self._empty_scores

    def update_provisional(self, early: Floats, settled: Floats, *, is_end: bool) -> None:
        """Combine the new scores of both networks, (m, states) each."""
        if is_end:
            self.reset()
        elif len(early) or len(settled):
            self._early_scores = np.concatenate([self._early_scores, early])[len(settled) :]
            late = self.late.provisional
            self.provisional = np.concatenate([late, self._early_scores[len(late) :]])
