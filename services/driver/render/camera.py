"""The camera of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

_MIN_ASPECT = 0.7  # narrower pictures show more above and below so that the face still fits


@dataclass(frozen=True, slots=True)
class Camera:
    """Camera position and lens; lengths in m, in the head's axes."""

    position: tuple[float, float, float] = (0.0, 0.030, 1.015)
    target: tuple[float, float, float] = (0.0, 0.018, 0.0)
    field_of_view_deg: float = 15.0  # vertical

    def view_projection(self, width_px: int, height_px: int) -> Float32:
        """Return the matrix (4, 4) from the head's axes to clip space."""
        eye = np.array(self.position)
        ahead = np.array(self.target) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, ahead), -ahead])
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = axes, -axes @ eye
        near, far = 0.1, 5.0
        scale = 1.0 / np.tan(np.radians(self.field_of_view_deg) / 2)
        scale *= min(1.0, width_px / height_px / _MIN_ASPECT)
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = scale * height_px / width_px, scale
        projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
        projection[3, 2] = -1.0
        return np.asarray(projection @ view, dtype=np.float32)
