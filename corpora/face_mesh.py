"""MediaPipe's face mesh: 468 landmarks of the face in each image of a video.

Sources: Bazarevsky et al. 2019, "BlazeFace: sub-millisecond neural face detection on mobile GPUs";
Kartynnik et al. 2019, "Real-time facial surface geometry from monocular video on mobile GPUs". The
two networks come from MediaPipe 0.10.14 (Apache-2.0), converted from TFLite to ONNX.

The detector searches the whole image for a face, at first and whenever the face is lost. The mesh
network processes a square around the face, turned so that the eyes are level. The square comes from
the detector or from the previous image's landmarks.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from kouxing.services.recognizer.acoustic.onnx_session import create_inference_session
from kouxing.shared.arrays import Doubles, Floats, UInt8

NUM_LANDMARKS = 468

_MODELS = Path(__file__).parent / "models"
_DETECTOR_PX, _MESH_PX = 128, 192  # sides of the networks' inputs
_STRIDES_PX = {8: 2, 16: 6}  # strides of the detector's grids, and anchors in each cell
_MARGIN = 1.5  # side of the square relative to the face's longer side
_RIGHT_EYE, _LEFT_EYE = 33, 263  # landmarks: the outer corners


@dataclass(frozen=True, slots=True)
class _Square:
    """A square in an image."""

    center: Doubles  # (2,) px
    side: float  # px
    angle: float  # clockwise, radians

    def to_pixels(self, points: Doubles) -> Doubles:
        """Convert points, (..., 2), from units of the side, relative to the center, to pixels."""
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        rotated = points @ np.array([[cos, sin], [-sin, cos]])
        return np.asarray(self.center + self.side * rotated)


class FaceMesh:
    """Tracks the face in the images of a video."""

    def __init__(self) -> None:
        self._detector = create_inference_session((_MODELS / "face_detector.onnx").read_bytes())
        self._mesh = create_inference_session((_MODELS / "face_mesh.onnx").read_bytes())
        self._anchors = _anchors()
        self._face: _Square | None = None  # in the last image

    def track(self, image: UInt8) -> Floats | None:
        """Find the most prominent face in the next image, RGB, (height, width, 3).

        Returns its landmarks in pixels, (468, 3): x to the right, y down, z away from the camera.
        """
        was_lost = self._face is None
        landmarks = self._landmarks(image)
        if landmarks is None and not was_lost:
            landmarks = self._landmarks(image)  # search the whole image
        return landmarks

    def _landmarks(self, image: UInt8) -> Floats | None:
        face = self._face or self._detect(image)
        self._face = None
        if face is None:
            return None
        pixels = _crop(image, face, _MESH_PX) / np.float32(255)
        points, presence = self._mesh.run(None, {"input0": pixels[None]})
        if presence.item() < 0:  # log odds
            return None
        relative = points.reshape(NUM_LANDMARKS, 3).astype(np.float64) / _MESH_PX
        landmarks = np.empty((NUM_LANDMARKS, 3))
        landmarks[:, :2] = face.to_pixels(relative[:, :2] - 0.5)
        landmarks[:, 2] = face.side * relative[:, 2]
        low, high = landmarks[:, :2].min(axis=0), landmarks[:, :2].max(axis=0)
        eyes = landmarks[_LEFT_EYE, :2] - landmarks[_RIGHT_EYE, :2]
        self._face = _face_square((low + high) / 2, high - low, eyes)
        return landmarks.astype(np.float32)

    def _detect(self, image: UInt8) -> _Square | None:
        height, width, _ = image.shape
        whole_image = _Square(np.array([width, height]) / 2, float(max(width, height)), 0.0)
        pixels = _crop(image, whole_image, _DETECTOR_PX) / np.float32(127.5) - 1
        boxes, scores = self._detector.run(None, {"input0": pixels[None]})
        best = int(scores[0, :, 0].argmax())
        if scores[0, best, 0] < 0:  # log odds
            return None
        center, size, right_eye, left_eye = boxes[0, best, :8].reshape(4, 2).astype(np.float64)
        origin = whole_image.to_pixels(self._anchors[best] + center / _DETECTOR_PX - 0.5)
        return _face_square(origin, whole_image.side * size / _DETECTOR_PX, left_eye - right_eye)


def _anchors() -> Doubles:
    """Return the centers of the detector's anchors, in units of its input's side, (896, 2)."""
    grids = []
    for stride_px, num_anchors in _STRIDES_PX.items():
        cells = (np.arange(_DETECTOR_PX // stride_px) + 0.5) * stride_px / _DETECTOR_PX
        y, x = np.meshgrid(cells, cells, indexing="ij")
        grids.append(np.repeat(np.stack([x.ravel(), y.ravel()], axis=1), num_anchors, axis=0))
    return np.concatenate(grids)


def _face_square(center: Doubles, size: Doubles, right_to_left_eye: Doubles) -> _Square:
    x, y = right_to_left_eye
    return _Square(center, _MARGIN * float(size.max()), float(np.arctan2(y, x)))


def _crop(image: UInt8, square: _Square, side_px: int) -> Floats:
    """Return a square of an image, (side_px, side_px, 3), black outside the image."""
    steps = (np.arange(side_px) + 0.5) / side_px - 0.5
    y, x = np.meshgrid(steps, steps, indexing="ij")
    positions = square.to_pixels(np.stack([x, y], axis=-1)) - 0.5
    rows_columns = positions[..., ::-1].transpose(2, 0, 1)
    channels = [
        map_coordinates(image[..., channel], rows_columns, np.float32, order=1)
        for channel in range(3)
    ]
    return np.stack(channels, axis=-1)
