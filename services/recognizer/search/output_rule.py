"""When a phone is emitted.

Source: Li et al. 2011, section 2.2, eq. 4 and fig. 3: the last phone of the best string so far is
emitted when the last N feature frames agree on it and it differs from the phone emitted before.

Deviation: a frame counts only if the search's confidence in its last phone is high enough. On
development data, one such frame gives fewer wrong phones, and sooner, than any N alone.
"""

from __future__ import annotations


class OutputRule:
    """Decides frame by frame.

    Parameters
    ----------
    num_stable_frames
        N, the number of feature frames that must agree; the paper found 3 best.
    min_confidence
        Confidence that a frame needs to count; 0 is the paper's rule.
    last_emitted
        Phone that counts as emitted at the beginning (silence, before speech).
    """

    def __init__(self, num_stable_frames: int, min_confidence: float, last_emitted: int) -> None:
        if num_stable_frames < 1:
            raise ValueError(f"num_stable_frames is {num_stable_frames}, expected 1 or more")
        self._num_stable_frames = num_stable_frames
        self._min_confidence = min_confidence
        self._initial = last_emitted
        self.reset()

    def reset(self) -> None:
        """Begin a new stretch of speech."""
        self.last_emitted = self._initial
        self._candidate = self._initial
        self._num_agreeing = 0

    def accept(self, phone: int, confidence: float) -> bool:
        """Take the last phone of the best string; return whether to emit it now."""
        if confidence < self._min_confidence:
            self._num_agreeing = 0
        else:
            self._num_agreeing = self._num_agreeing + 1 if phone == self._candidate else 1
        self._candidate = phone
        # Li 2011, eq. 4
        if self._num_agreeing >= self._num_stable_frames and phone != self.last_emitted:
            self.last_emitted = phone
            return True
        return False
