"""Estimates arousal, valence, laughter and breath from the voice.

A linear readout of the audio encoder's hidden layers, every 20 ms:

======== ============================================================= ======================
symbol   meaning                                                       shape
======== ============================================================= ======================
h        state of the encoder's recurrent layers                       (state width,)
W, b     weights of the readout                                        (state width, 4), (4,)
y        arousal and valence (-1 to 1), evidence of laughter and       (4,)
         of breath (0 to 1)
m        mean of arousal and valence over the session's voice          (2,)
======== ============================================================= ======================

    y = W^T h + b

Arousal and valence are averaged over two seconds of voice. Voices and microphones differ more than
feelings do, so the reported values are relative to ``m``. Arousal and valence are the axes of
Russell 1980, "A circumplex model of affect". :mod:`kouxing.training.voice_traits` trains the
readout.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from kouxing.services.recognizer.acoustic.encoder import EncoderOutput, VoiceKind, load_encoder
from kouxing.services.recognizer.acoustic.model_file import Archive, load_component
from kouxing.shared.arrays import Floats

TRAITS_PATH = Path(__file__).parents[1] / "models" / "traits.npz"
FORMAT = "traits 1"
NUM_TRAITS = 4  # arousal, valence, laughter, breath
MIN_VOICE = 0.5  # smallest probability of a voice at which arousal and valence count

_FEELING = slice(0, 2)
_FEELING_PRIOR_WEIGHT = 20  # weight of the prior arousal and valence, encoder frames
_FEELING_MEMORY = 100  # memory of arousal and valence, encoder frames
_VOICE_PRIOR_WEIGHT = 400  # weight of the prior in m, encoder frames
_VOICE_MEMORY = 6000  # memory of m, encoder frames
_DIGITS = 2  # feelings change slowly, so that equal messages compress well
_EVIDENCE_FRACTION = 0.1  # weight of a new encoder frame
_START, _STOP = 0.35, 0.15  # evidence at which laughter or breath starts and stops
_MIN_LAUGHTER = 0.3  # minimum probability of a laugh
_LAUGH_ENCODER_FRAMES = 50  # laughter ends after this many encoder frames without a laugh


class VoiceTraits(NamedTuple):
    """Traits of a voice; the fields have the names in ``Progress``."""

    arousal: float = 0.0
    valence: float = 0.0
    is_laughter: bool = False
    is_breath: bool = False


@dataclass(frozen=True, slots=True)
class VoiceReadout:
    """The trained readout, shared by any number of streams."""

    weights: Floats  # W
    bias: Floats  # b
    mean: Floats  # (2,) arousal and valence of the training speakers


class VoiceTraitsStream:
    """The traits of one session's voice."""

    def __init__(self, readout: VoiceReadout) -> None:
        self.newest = VoiceTraits()
        self._readout = readout
        self._feeling: list[float] = readout.mean.tolist()
        self._mean = self._feeling
        self._num_voiced = 0  # encoder frames with a voice
        self._evidence = [0.0] * (NUM_TRAITS - 2)  # evidence of laughter and of breath
        self._since_laugh = _LAUGH_ENCODER_FRAMES  # encoder frames since a laugh

    def process_encoder_frame(self, output: EncoderOutput) -> None:
        """Process the next encoder frame."""
        # For so few numbers, lists are faster than arrays.
        outputs: list[float] = (output.state @ self._readout.weights + self._readout.bias).tolist()
        if output.voice[VoiceKind.SPEECH] + output.voice[VoiceKind.SUNG] > MIN_VOICE:
            self._num_voiced += 1
            feeling = outputs[_FEELING]
            num_known = min(self._num_voiced + _VOICE_PRIOR_WEIGHT, _VOICE_MEMORY)
            self._mean = [m + (f - m) / num_known for m, f in zip(self._mean, feeling, strict=True)]
            gain = 1.0 / min(self._num_voiced + _FEELING_PRIOR_WEIGHT, _FEELING_MEMORY)
            self._feeling = [
                old + gain * (new - old) for old, new in zip(self._feeling, feeling, strict=True)
            ]
        self._evidence = [
            old + _EVIDENCE_FRACTION * (new - old)
            for old, new in zip(self._evidence, outputs[2:], strict=True)
        ]
        is_laugh = output.voice[VoiceKind.LAUGHTER] > _MIN_LAUGHTER
        self._since_laugh = 0 if is_laugh else self._since_laugh + 1
        arousal, valence = (
            round(min(max(value - mean, -1.0), 1.0), _DIGITS)
            for value, mean in zip(self._feeling, self._mean, strict=True)
        )
        laughter, breath = (
            evidence > (_STOP if was_on else _START)
            for evidence, was_on in zip(self._evidence, self.newest[2:], strict=True)
        )
        # the encoder's state contains past laughter for many seconds of silence
        laughter = laughter and self._since_laugh < _LAUGH_ENCODER_FRAMES
        self.newest = VoiceTraits(arousal, valence, laughter, breath)


@cache
def load_voice_readout(path: Path = TRAITS_PATH) -> VoiceReadout:
    """Read a model file; raises ``UserError`` if it is missing, broken or of another format."""
    return load_component(path, FORMAT, "readout of voice traits", _parse_readout)


def _parse_readout(archive: Archive) -> VoiceReadout:
    return VoiceReadout(
        weights=archive.floats("weights", load_encoder().state_width, NUM_TRAITS),
        bias=archive.floats("bias", NUM_TRAITS),
        mean=archive.floats("mean", 2),
    )
