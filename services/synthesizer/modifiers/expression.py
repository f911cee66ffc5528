"""Adds requested expressions to a speaking face."""

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.expression_motion import ExpressionMotion


class ExpressionModifier(ExpressionMotion):
    """Expressions that leave the lips to speech."""

    def apply(self, faps: NDArray[np.float32], context: FrameContext) -> None:
        """Add the expressions to a frame, FAPs (68,), in place."""
        self.add(faps, context.step_s, is_speaking=context.is_speaking)
