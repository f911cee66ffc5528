"""The face mesh finds the landmarks that MediaPipe finds."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from kouxing.corpora.face_mesh import FaceMesh

PICTURES = Path(__file__).parents[1] / "golden"
# x and y of landmarks as MediaPipe 0.10.14 finds them in the stored pictures
MEDIAPIPE = {
    "woman_a": {13: (95.8, 99.8), 14: (95.9, 103.0), 61: (85.6, 100.5), 291: (106.6, 100.5)},
    "man_a": {13: (96.2, 97.7), 14: (96.4, 102.2), 152: (96.6, 123.8), 33: (71.2, 56.8)},
    "woman_turned": {13: (117.3, 98.9), 61: (104.5, 99.6), 291: (123.9, 98.0), 4: (122.1, 82.7)},
}


def picture(name: str) -> NDArray[np.uint8]:
    return np.asarray(Image.open(PICTURES / f"face_{name}.png").convert("RGB"))


@pytest.mark.parametrize("name", MEDIAPIPE)
def test_finds_mediapipes_landmarks(name: str) -> None:
    landmarks = FaceMesh().track(picture(name))
    assert landmarks is not None
    for point, expected in MEDIAPIPE[name].items():
        np.testing.assert_allclose(landmarks[point, :2], expected, atol=0.8)
