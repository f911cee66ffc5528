"""Laughter of the voice on the face."""

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.expression import SpeechExpression
from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.expressions import ExpressionName

_HOLD_S = 0.2  # after the last frame of laughter


class Laughter(SpeechExpression):
    """Shows joy while someone laughs."""

    def apply(self, faps: NDArray[np.float32], context: FrameContext) -> None:
        """Add the laughter to a frame, FAPs (68,), in place."""
        if context.is_laughter:
            self.show({ExpressionName.JOY: 1.0}, _HOLD_S)
        super().apply(faps, context)
