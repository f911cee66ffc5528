"""A lip predictor with random weights for the shipped encoder."""

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.lips.lip_predictor import NUM_OUTPUTS, GruLipPredictor

NUM_FEATURES, NUM_COMPONENTS, UNITS, NUM_LIPS = 160 + 307, 6, 5, 51  # log-mel, encoder's features
DELAYS_S = (-0.005, 0.055, 0.155)


def random_lip_predictor() -> GruLipPredictor:
    rng = np.random.default_rng(0)
    outputs = (len(DELAYS_S), NUM_OUTPUTS)

    def draw(*shape: int, spread: float = 0.3) -> NDArray[np.float32]:
        return rng.normal(0, spread, shape).astype(np.float32)

    return GruLipPredictor(
        delays=np.array(DELAYS_S, np.float32),
        feature_mean=draw(NUM_FEATURES),
        projection=draw(NUM_FEATURES, NUM_COMPONENTS, spread=0.01),
        entry_weights=draw(NUM_COMPONENTS, UNITS),
        entry_bias=draw(UNITS),
        input_weights=draw(UNITS, 3 * UNITS),
        input_bias=draw(3 * UNITS),
        state_weights=draw(UNITS, 3 * UNITS),
        state_bias=draw(3 * UNITS),
        lip_weights=draw(NUM_LIPS, *outputs),
        output_weights=draw(2 * UNITS, *outputs),
        output_bias=draw(*outputs),
    )
