"""A clip with a mouth to evaluate.

A lip model predicts the mouth, or it is the clip's real mouth, as the reference. A measure pools a
group of scored clips.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.lips.closures import Contact, DetectionCounts, closures, contacts
from kouxing.evaluation.lips.misalignment import misalignment_s
from kouxing.evaluation.lips.mouths import Mouth
from kouxing.evaluation.lips.references import Reference

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ScoredClip:
    """A clip and the mouth to evaluate. Figures are cached, because groups of clips overlap."""

    reference: Reference
    predicted: Mouth

    @property
    def real(self) -> Mouth:
        """The clip's real mouth."""
        return self.reference.mouth

    @cached_property
    def in_speech(self) -> Mask:
        """Whether there is speech, at the times of the real frames."""
        return self.reference.is_speech(self.real.time_s)

    @cached_property
    def opening_in_speech(self) -> Array:
        """The opening during speech, at the times of the real frames."""
        return self.predicted.at("opening", self.real.time_s)[self.in_speech]

    @cached_property
    def closures(self) -> DetectionCounts:
        """Real and predicted closures."""
        return closures(self.predicted, self.real)

    @cached_property
    def contacts(self) -> list[Contact]:
        """Predicted closures."""
        return contacts(self.predicted, self.real)

    @cached_property
    def misalignment_s(self) -> float | None:
        """Mean temporal misalignment."""
        return misalignment_s(self.predicted, self.real)


ScoredClips = Sequence[ScoredClip]
Measure = Callable[[ScoredClips], float | None]
