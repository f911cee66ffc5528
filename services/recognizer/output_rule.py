"""When a unit is sure enough to be put out.

Source: Li et al. 2011, section 2.2, eq. 4 and fig. 3: the last unit of the best string so far is
put out when the last N feature frames agree on it and it differs from the unit put out before.

Deviation: a frame in which the search is not sure of its last unit can be made not to count as
agreeing. On development data one sure frame gives fewer wrong units, and sooner, than any N alone.
"""

from __future__ import annotations


class OutputRule:
    """Decides frame by frame.

    Parameters
    ----------
    agreement
        N, the number of feature frames that must agree; the paper found 3 best.
    least_confidence
        Confidence that a frame needs to count as agreeing; 0 is the paper's rule.
    last_output
        The unit taken as put out at the beginning (silence, before speech).
    """

    def __init__(self, agreement: int, least_confidence: float, last_output: int) -> None:
        if agreement < 1:
            raise ValueError(f"agreement is {agreement}, expected 1 or more")
        self._agreement = agreement
        self._least_confidence = least_confidence
        self._first_output = last_output
        self.reset()

    def reset(self) -> None:
        """Begin a new piece of speech."""
        self.last_output = self._first_output
        self._candidate = self._first_output
        self._num_agreeing = 0

    def accept(self, unit: int, confidence: float) -> bool:
        """Take the last unit of the best string; return whether it is to be put out now."""
        if confidence < self._least_confidence:
            self._num_agreeing = 0
        else:
            self._num_agreeing = self._num_agreeing + 1 if unit == self._candidate else 1
        self._candidate = unit
        # Li 2011, eq. 4
        if self._num_agreeing >= self._agreement and unit != self.last_output:
            self.last_output = unit
            return True
        return False
