"""The interface of lip predictors: models that predict lip positions from the audio.

The audio encoder computes features for every encoder frame, 50 times a second. From these features,
the model predicts lip positions during speech. A model offers several delays; the recognizer
chooses one.
"""

from collections.abc import Sequence
from typing import Protocol, Self

from kouxing.shared.arrays import Floats
from kouxing.shared.phones.events import LipPositions

# FAP frames are due every 20 ms of audio. An encoder frame ends this much earlier, because windows
# of 25 ms in steps of 20 ms cannot end closer.
ENCODER_FRAME_LAG_S = 0.005


class LipPredictorStream(Protocol):
    """Predicts the lip positions of one session, segment by segment."""

    def process_encoder_frame(
        self, known_s: float, frames: Floats, features: Floats
    ) -> list[LipPositions]:
        """Return the lip positions that an encoder frame determines.

        ``known_s`` is the media time of its last sample, ``frames`` are its two log-mel frames,
        (2, 80), and ``features`` are those of the encoder, (features,).
        """

    def reset(self) -> None:
        """Start a new segment of speech."""


class LipPredictor(Protocol):
    """A trained model, shared by any number of streams."""

    @property
    def delays_s(self) -> Sequence[float]:
        """Available delays in seconds, ascending."""

    def create_stream(self, delays_s: Sequence[float]) -> LipPredictorStream:
        """Create a session's stream with some of the delays."""

    def with_mouth_profile(self, content: bytes) -> Self:
        """Adapt the model to a mouth profile's speaker; raises ``UserError`` if it does not fit."""


def choose_delay(delays_s: Sequence[float], face_delay_s: float) -> float:
    """Choose the longest delay whose lip positions are in time for a face with this delay."""
    in_time = [delay for delay in delays_s if delay + ENCODER_FRAME_LAG_S <= face_delay_s + 1e-6]
    return max(in_time, default=min(delays_s))
