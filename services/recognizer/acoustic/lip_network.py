"""A model of phones with the causal network beside it, whose positions the lips are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from services.recognizer.acoustic.acoustic_model import OnPosition, Topology, Work
from services.recognizer.acoustic.network import Floats
from services.recognizer.acoustic.neural import NeuralModel, NeuralStream
from services.recognizer.acoustic.window import WindowModel, WindowStream
from services.recognizer.front_end.whisper_mel import WhisperMel
from shared.phones.inventory import PhoneInventory


@dataclass(frozen=True)
class ModelWithLipNetwork:
    """Two networks that hear the same frames; implements ``AcousticModel``."""

    phones: WindowModel  # scores the states
    lips: NeuralModel  # its scores are not used

    @property
    def topology(self) -> Topology:
        """The HMMs whose states are scored."""
        return self.phones.topology

    @property
    def inventory(self) -> PhoneInventory:
        """The language's phones."""
        return self.phones.inventory

    def front_end(self) -> WhisperMel:
        """Start a front end for one session."""
        return self.phones.front_end()

    def stream(self) -> StreamWithLipNetwork:
        """Start a stream of scores and positions for one speaker."""
        return StreamWithLipNetwork(self)

    def score(self, work: Sequence[Work]) -> list[Floats]:
        """Score frames of several streams; None ends a stream's segment."""
        streams = [(cast(StreamWithLipNetwork, stream), frames) for stream, frames in work]
        self.lips.score([(stream.lips, frames) for stream, frames in streams])
        return self.phones.score([(stream.phones, frames) for stream, frames in streams])


class StreamWithLipNetwork:
    """Scores and positions of one speaker's speech, segment by segment."""

    def __init__(self, model: ModelWithLipNetwork) -> None:
        self._model = model
        self.phones: WindowStream = model.phones.stream()
        self.lips: NeuralStream = model.lips.stream()
        self.look_ahead_frames = self.phones.look_ahead_frames

    @property
    def provisional(self) -> Floats:
        """Scores of the frames that follow the settled ones, (k, states)."""
        return self.phones.provisional

    @property
    def on_position(self) -> OnPosition | None:
        """Is called for every position, in order; None: nobody asks."""
        return self.lips.on_position

    @on_position.setter
    def on_position(self, called: OnPosition | None) -> None:
        self.lips.on_position = called

    def accept(self, frames: Floats) -> Floats:
        """Take frames, shape (n, 80); return the scores ready, (m, states)."""
        return self._model.score([(self, frames)])[0]

    def finish(self) -> Floats:
        """End the segment; return its remaining scores."""
        return self._model.score([(self, None)])[0]

    def reset(self) -> None:
        """Forget the segment."""
        self.phones.reset()
        self.lips.reset()
