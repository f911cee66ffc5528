"""Frames of the package ``kouxing-lips`` and of the server."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.system import lips_package
from kouxing.evaluation.system.lips_package import package_faps
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.phones.events import SoundEvent

RATE_HZ = 16_000
DELAY_S, FRAME_RATE_HZ = 0.06, 50.0
TONGUE = [13, 43, 44, 45, 46]  # FAPs 14, and 44 to 47: jaw thrust and tongue
Frames = NDArray[np.float32]


def package_output(models: Path, samples: Frames, **options: Any) -> dict[str, Any]:
    return lips_package.package_output(
        models, samples, **{"chunk": 441, "shapes": [*SHAPE_SETS], **options}
    )


def faps_of(models: Path, samples: Frames, **options: Any) -> Frames:
    return package_faps(package_output(models, samples, **options))


def server_faps(events: Sequence[SoundEvent], feeling: float | None = None) -> Frames:
    """Return the server's frames without idle motion and tongue."""
    faps = lips_package.server_faps(events, feeling)
    faps[:, TONGUE] = 0.0
    return faps
