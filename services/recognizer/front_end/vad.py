"""Voice activity detection (VAD): starts and ends of speech, and of laughter.

The small ear computes the probabilities of the kinds of voice every 20 ms. A detector follows one
of them. It starts as soon as there is enough evidence (a cumulative sum, Page 1954):

======== ============================================================= ====
symbol   meaning                                                       unit
======== ============================================================= ====
p        probability of the kind of voice                              1
d        probability that counts as no evidence                        1
e        evidence                                                      1
======== ============================================================= ====

    e(n) = max(0, e(n - 1) + p(n) - d)

It ends when the voice has been improbable for half a second. A pre-roll restores the audio before
the detection of speech (see :mod:`kouxing.services.recognizer.speech_segmenter`).
"""

from kouxing.services.recognizer.acoustic.acoustic_model import Floats
from kouxing.services.recognizer.ear import Voice

_IMPROBABLE = 0.3  # one weak syllable does not end the speech, only many such positions do
_STOP_POSITIONS = 25  # half a second: longer than a closure or a breath between phrases


class VoiceActivityDetector:
    """Follows one stream, position by position."""

    def __init__(self) -> None:
        self._speech = _Detector(no_evidence=0.75, enough=0.12)
        self._laughter = _Detector(no_evidence=0.2, enough=3.0)  # it pauses between bursts

    @property
    def is_speech(self) -> bool:
        """Whether someone speaks or sings, so the audio is recognized."""
        return self._speech.is_on

    @property
    def is_laughter(self) -> bool:
        """Whether someone laughs."""
        return self._laughter.is_on

    def update(self, voice: Floats) -> None:
        """Take the probabilities of a position, (4,), by ``Voice``."""
        self._speech.update(float(voice[Voice.SPEECH] + voice[Voice.SUNG]))
        self._laughter.update(float(voice[Voice.LAUGHTER]))


class _Detector:
    """Follows the probability of one kind of voice."""

    def __init__(self, *, no_evidence: float, enough: float) -> None:
        self.is_on = False
        self._no_evidence = no_evidence
        self._enough = enough
        self._evidence = 0.0
        self._num_improbable = 0  # positions in a row

    def update(self, probability: float) -> None:
        """Take the probability at the next position."""
        self._num_improbable = 0 if probability >= _IMPROBABLE else self._num_improbable + 1
        if self.is_on:
            self.is_on = self._num_improbable < _STOP_POSITIONS
            return
        self._evidence = max(0.0, self._evidence + probability - self._no_evidence)
        self.is_on = self._evidence >= self._enough
        if self.is_on:
            self._evidence = 0.0
