"""Records the inputs of the lip predictor for whole recordings.

Voice activity detection runs as in the live recognizer.
"""

import numpy as np

from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.lips.lip_predictor import join_features
from kouxing.services.recognizer.live.speech_segmenter import SpeechSegmenter
from kouxing.shared.arrays import Float16, Floats
from kouxing.shared.phones.events import LipPositions

ENCODER_FRAME_S = FRAMES_PER_ENCODER_FRAME * HOP_S


class LipInputs:
    """Records the lip predictor's inputs over one recording; implements ``LipPredictorStream``."""

    def __init__(self) -> None:
        self.starts: list[int] = []  # first encoder frame of each segment of speech
        self.known_s: list[float] = []  # media time up to which the audio is known
        self.features: list[Float16] = []  # (features,) of each encoder frame

    def process_encoder_frame(
        self, known_s: float, frames: Floats, features: Floats
    ) -> list[LipPositions]:
        """Store the features of an encoder frame."""
        self.known_s.append(known_s)
        self.features.append(join_features(frames, features).astype(np.float16))
        return []

    def reset(self) -> None:
        """Mark the start of a segment of speech."""
        self.starts.append(len(self.known_s))


def record_lip_inputs(samples: Floats) -> LipInputs:
    """Run the audio encoder over a recording, 16 kHz mono, (n,)."""
    inputs = LipInputs()
    segmenter = SpeechSegmenter(WhisperMel(), inputs)
    for _ in segmenter.accept_waveform(to_16_khz(samples, SAMPLE_RATE_HZ)):
        pass  # only the encoder frames are needed
    return inputs
