"""The output rule: decides when a phone is emitted.

Source: Li et al. 2011, section 2.2, eq. 4 and fig. 3: the last phone of the best string so far is
emitted when the last N feature frames agree on it and it differs from the phone emitted before.

Deviation: a frame counts only if the search is confident enough of its last phone. On development
data, one such frame emits phones earlier, with fewer errors, than any N without this condition.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class OutputRuleConfig:
    """Parameters of the output rule. The paper's rule is N = 3 and any confidence."""

    num_stable_frames: int = 2  # N: feature frames that must agree
    min_confidence: float = 0.95  # a frame counts only with this confidence or more, 0 to 1


# Defaults of the models that need other parameters, by the model's name.
MODEL_RULES = dict.fromkeys(("light", "gmm"), OutputRuleConfig(1, 0.9))


class OutputRule:
    """Decides at each frame whether to emit a phone.

    ``last_emitted`` is the phone that counts as emitted at the start: silence before speech.
    """

    def __init__(self, config: OutputRuleConfig, last_emitted: int) -> None:
        if config.num_stable_frames < 1:
            raise ValueError(f"num_stable_frames is {config.num_stable_frames}, expected 1 or more")
        self._config = config
        self.min_confidence = config.min_confidence
        self._initial = last_emitted
        self.reset()

    def reset(self) -> None:
        """Start a new segment of speech."""
        self.last_emitted = self._candidate = self._initial
        self._num_agreeing = 0

    def update(self, phone: int, confidence: float) -> bool:
        """Return whether to emit the last phone of the best string at this frame."""
        if confidence < self._config.min_confidence:
            self._num_agreeing = 0
        else:
            self._num_agreeing = self._num_agreeing + 1 if phone == self._candidate else 1
        self._candidate = phone
        # Li 2011, eq. 4
        if self._num_agreeing < self._config.num_stable_frames or phone == self.last_emitted:
            return False
        self.last_emitted = phone
        return True
