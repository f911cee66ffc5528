"""Record what the recognizer passes to the lip model for whole recordings.

Voice activity detection runs as in the live recognizer. The network therefore restarts at each
stretch of speech.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lip_predictor import features_at
from kouxing.services.recognizer.speech_scorer import SpeechScorer, score_streams
from kouxing.shared.phones.events import LipPositions

Floats = NDArray[np.float32]

POSITION_S = FRAMES_PER_POSITION * HOP_S


class LipInputs:
    """The lip model's inputs over one recording."""

    def __init__(self) -> None:
        self.starts: list[int] = []  # first position of each stretch of speech
        self.known_s: list[float] = []  # media time up to which the audio is known
        self.features: list[NDArray[np.float16]] = []  # of each position, (features,)

    def process_position(
        self, known_s: float, frames: Floats, values: Floats
    ) -> list[LipPositions]:
        """Store the network's values at a position."""
        self.known_s.append(known_s)
        self.features.append(features_at(frames, values).astype(np.float16))
        return []

    def reset(self) -> None:
        """Mark the start of a stretch of speech."""
        self.starts.append(len(self.known_s))


def record_positions(model: NeuralModel, recordings: Sequence[Floats]) -> list[LipInputs]:
    """Run the network over recordings, each 16 kHz mono, (n,).

    Processing them together takes half the time. It does not change the values.
    """
    positions = [LipInputs() for _ in recordings]
    scorers = [SpeechScorer(model, recorder) for recorder in positions]
    for scorer, samples in zip(scorers, recordings, strict=True):
        scorer.accept_waveform(to_16_khz(samples, SAMPLE_RATE_HZ))
        scorer.input_finished()
    score_streams(model, scorers)
    return positions
