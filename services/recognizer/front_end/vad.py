"""Voice activity detection (VAD): finds speech in the audio.

A network (Silero VAD 6.2, MIT) computes a speech probability every 32 ms. Three states turn it into
starts and ends of speech:

    quiet --probable--> speaking --improbable--> stopping --for STOP_BLOCKS--> quiet
                            ^                       |
                            +-------probable--------+

Onset delay: a block of 32 ms is judged when it is complete. If the first block of speech is
probable at once, speech is detected up to 32 ms after it starts. Waiting for a second block
rejected no more noise in tests, neither clicks nor knocks. A pre-roll restores the audio before
the detection (see :mod:`kouxing.services.recognizer.speech_scorer`).

======== ================================================================ =============
symbol   meaning                                                          shape
======== ================================================================ =============
x        a block, preceded by 64 samples of context                       (1, 576)
h        state of its long short-term memory, hidden and cell             (2, 1, 128)
======== ================================================================ =============

Deviation: the context is the mirrored start of the block, as the network mirrors the end of the
block. Silero's code takes the last samples of the previous block instead.

Cost: about 4 ms of one core per second of audio.
"""

from __future__ import annotations

from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.onnx_session import open_network

BLOCK_SAMPLES = 512  # at 16 kHz: 32 ms, fixed by the network
_PROBABLE = 0.2  # enough to start: the lips must not miss the first syllable
_IMPROBABLE = 0.35  # one weak syllable does not end the speech, only many such blocks do
_STOP_BLOCKS = 16  # half a second: longer than a closure or a breath between phrases

_NETWORK = Path(__file__).parents[1] / "models" / "silero_vad.onnx"
_CONTEXT_SAMPLES = 64
_STATE_SHAPE = (2, 1, 128)


class VoiceState(Enum):
    """The three states."""

    QUIET = "quiet"
    SPEAKING = "speaking"
    STOPPING = "stopping"

    @property
    def is_speech(self) -> bool:
        """Whether the audio is recognized."""
        return self is not VoiceState.QUIET


class VoiceActivityDetector:
    """Follows one stream block by block."""

    def __init__(self) -> None:
        self.state = VoiceState.QUIET
        self._num_blocks = 0  # in stopping
        self._network_state = np.zeros(_STATE_SHAPE, np.float32)

    def detect(self, samples: NDArray[np.float32]) -> VoiceState:
        """Return the state after the next block, shape (512,)."""
        return self.update(self.speech_probability(samples))

    def speech_probability(self, samples: NDArray[np.float32]) -> float:
        """Return the probability of speech in the next block, shape (512,)."""
        mirrored = samples[_CONTEXT_SAMPLES:0:-1]
        inputs = {"input": np.concatenate([mirrored, samples])[None], "state": self._network_state}
        probability, self._network_state = _network().run(["output", "stateN"], inputs)
        return float(probability[0, 0])

    def update(self, probability: float) -> VoiceState:
        """Return the state after a block with this speech probability."""
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


@cache
def _network() -> Any:
    """Return the network that all detectors share."""
    return open_network(_NETWORK.read_bytes())
