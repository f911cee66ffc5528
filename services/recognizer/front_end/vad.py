"""Voice activity detection (VAD): starts and ends of speech.

The audio encoder computes the probabilities of the kinds of voice every 20 ms. Speech starts as
soon as there is enough evidence (a cumulative sum, Page 1954):

======== ============================================================= ====
symbol   meaning                                                       unit
======== ============================================================= ====
p        probability of speech or singing                              1
d        probability that counts as no evidence                        1
e        evidence                                                      1
======== ============================================================= ====

    e(n) = max(0, e(n - 1) + p(n) - d)

It ends when the voice has been improbable for half a second. A pre-roll restores the audio before
the detection of speech (see :mod:`kouxing.services.recognizer.live.speech_segmenter`).
"""

from kouxing.services.recognizer.acoustic.encoder import VoiceKind
from kouxing.shared.arrays import Floats

_NO_EVIDENCE, _ENOUGH = 0.75, 0.12  # d, and the evidence at which speech starts
_IMPROBABLE = 0.3  # one weak syllable does not end the speech, only many such frames do
_STOP_ENCODER_FRAMES = 25  # half a second: longer than a closure or a breath between phrases


class VoiceActivityDetector:
    """Detects speech in one stream, one encoder frame at a time."""

    def __init__(self) -> None:
        self.is_speech = False  # whether there is speech or singing, so the audio is recognized
        self._evidence = 0.0
        self._num_improbable = 0  # encoder frames in a row

    def update(self, voice: Floats) -> None:
        """Process the probabilities of an encoder frame, (4,), by ``VoiceKind``."""
        probability = float(voice[VoiceKind.SPEECH] + voice[VoiceKind.SUNG])
        self._num_improbable = 0 if probability >= _IMPROBABLE else self._num_improbable + 1
        if self.is_speech:
            self.is_speech = self._num_improbable < _STOP_ENCODER_FRAMES
            return
        self._evidence = max(0.0, self._evidence + probability - _NO_EVIDENCE)
        self.is_speech = self._evidence >= _ENOUGH
        if self.is_speech:
            self._evidence = 0.0
