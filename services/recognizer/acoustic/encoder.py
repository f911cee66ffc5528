"""The audio encoder: a recurrent network that processes all audio, with and without speech.

It computes the inputs of the voice activity detector and the lip predictor. An *encoder frame* is
20 ms of audio, two log-mel frames.

======== ======================================================== ==================
symbol   meaning                                                  shape
======== ======================================================== ==================
x        the two log-mel frames of an encoder frame               (160,)
h        state of the recurrent layers                            (state width,)
f        features for a lip predictor                             (features,)
q        log posteriors of the phones of the default language,    (phones,)
         for the frames ``PHONES_LAG_FRAMES`` earlier
v        probabilities of the kinds of voice (``VoiceKind``),     (4,)
         for the audio 40 ms earlier
======== ======================================================== ==================

:mod:`kouxing.training.encoder` trains the network.
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kouxing.services.recognizer.acoustic.model_file import load_component
from kouxing.services.recognizer.acoustic.network import (
    FRAMES_PER_ENCODER_FRAME,
    check_outputs,
    open_onnx_session,
    run_onnx_session,
)
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.shared.arrays import Floats, UInt8

ENCODER_PATH = Path(__file__).parents[1] / "models" / "encoder.npz"
FORMAT = "encoder 1"

PHONES_LAG_FRAMES = 5
LIP_DELAYS_S = (0.015, 0.055, 0.155)  # delays of the lips at the end of the features

_OUTPUTS = ["features", "phones", "voice", "new_state"]
_MAX_WIDTH = 4096


class VoiceKind(IntEnum):
    """Kinds of voice that the encoder distinguishes."""

    NONE = 0
    SPEECH = 1
    SUNG = 2  # or a held sound
    LAUGHTER = 3


class EncoderOutput(NamedTuple):
    """The encoder's outputs for an encoder frame; shapes as above."""

    frames: Floats  # x as (2, 80)
    features: Floats
    phones: Floats
    voice: Floats
    state: Floats  # h after the encoder frame


class AudioEncoder:
    """The encoder network, shared by any number of streams."""

    def __init__(self, file: UInt8) -> None:
        """Open an ONNX file; raises ``ValueError`` if it does not contain an audio encoder."""
        self._session = open_onnx_session(file)
        nodes = [*self._session.get_inputs(), *self._session.get_outputs()]
        widths = {node.name: node.shape[-1] for node in nodes}
        self.state_width, self.num_features, self.num_phones = (
            widths.get(name, 0) for name in ("state", "features", "phones")
        )
        for width in (self.state_width, self.num_features, self.num_phones):
            if not (isinstance(width, int) and 1 <= width <= _MAX_WIDTH):
                raise ValueError(f"its network has widths {widths}, not 1 to {_MAX_WIDTH}")
        values = self.run(
            np.zeros((1, FRAMES_PER_ENCODER_FRAME, NUM_MELS), np.float32),
            np.zeros((1, self.state_width), np.float32),
        )
        sizes = (self.num_features, self.num_phones, len(VoiceKind), self.state_width)
        check_outputs(values, [(1, size) for size in sizes])

    def run(self, frames: Floats, states: Floats) -> list[Floats]:
        """Compute f, q, v and the new state of n encoder frames: x is (n, 2, 80), h is (n, -).

        Other encoder frames do not affect the results of one.
        """
        inputs = {"frames": frames.reshape(len(frames), -1), "state": states}
        outputs: list[Floats] = run_onnx_session(self._session, _OUTPUTS, inputs)
        return outputs


class EncoderStream:
    """Runs the encoder on one session's audio, one encoder frame at a time."""

    def __init__(self, encoder: AudioEncoder) -> None:
        self.encoder = encoder
        self.state = np.zeros(encoder.state_width, np.float32)

    def process_encoder_frame(self, frames: Floats) -> EncoderOutput:
        """Process the next encoder frame: its two feature frames, (2, 80)."""
        return process_encoder_frames([self], [frames])[0]


def process_encoder_frames(
    streams: Sequence[EncoderStream], frames: Sequence[Floats]
) -> list[EncoderOutput]:
    """Process the next encoder frame, (2, 80), of several streams of one encoder in one run."""
    states = np.array([stream.state for stream in streams])
    outputs = streams[0].encoder.run(np.array(frames), states)
    results = []
    for stream, mels, *rows in zip(streams, frames, *outputs, strict=True):
        features, phones, voice, state = (row.copy() for row in rows)  # a view would keep all rows
        stream.state = state
        results.append(EncoderOutput(mels, features, phones, voice, state))
    return results


@cache
def load_encoder(path: Path = ENCODER_PATH) -> AudioEncoder:
    """Read a model file; raises ``UserError`` if it is missing, broken or of another format."""
    return load_component(
        path,
        FORMAT,
        "audio encoder",
        lambda file: AudioEncoder(file.array("network", None).astype(np.uint8)),
    )
