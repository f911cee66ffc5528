"""What a model of lips from sound is told of whole recordings, as in the product.

The voice detector and the sound before its decision are those of the live recognizer, so the
network starts again with each stretch of speech.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import run_scoring_tasks
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.services.recognizer.lips import features_at
from kouxing.services.recognizer.speech_scores import SpeechScores
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.phones.events import LipFrame

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

POSITION_S = FRAMES_PER_POSITION * HOP_S


class LipPositions:
    """Keeps what lips from sound are told.

    Attributes
    ----------
    starts : list of int
        First position of each stretch of speech.
    known_s : list of float
        Media time up to which the sound is known at each position.
    features : list of NDArray
        Of each position as ``LipPredictor`` takes them, (features,).
    """

    def __init__(self) -> None:
        self.starts: list[int] = []
        self.known_s: list[float] = []
        self.features: list[NDArray[np.float16]] = []

    def accept(self, known_s: float, frames: Floats, values: Floats) -> list[LipFrame]:
        """Take what the network computes at a position."""
        self.known_s.append(known_s)
        self.features.append(features_at(frames, values).astype(np.float16))
        return []

    def reset(self) -> None:
        """Note that a stretch of speech begins."""
        self.starts.append(len(self.known_s))


def lip_positions(model: NeuralModel, recordings: Sequence[Floats]) -> list[LipPositions]:
    """Return all positions of recordings, each 16 kHz mono, shape (n,).

    The network hears them side by side, which takes half the time; no value depends on it.
    """
    positions = [LipPositions() for _ in recordings]
    scores = [SpeechScores(model, MEDIA_RATE_HZ, lips=each) for each in positions]
    run_scoring_tasks(
        model,
        [each.process(samples) for each, samples in zip(scores, recordings, strict=True)],
    )
    run_scoring_tasks(model, [each.finish() for each in scores])
    return positions
