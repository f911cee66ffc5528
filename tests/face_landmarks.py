"""Landmarks of a made-up face, and files of them."""

import json

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kouxing.services.mouth_profiles.face_landmarks import _STABLE_POINTS, LANDMARKS

NUM_FRAMES = 60
MOUTH = {
    2: (0, -2, 6), 13: (0, -3.99, 5.2), 14: (0, -4.01, 5.4), 78: (-2.2, -4, 4), 308: (2.2, -4, 4),
    81: (-1, -3.99, 5), 311: (1, -3.99, 5), 178: (-1, -4.01, 5), 402: (1, -4.01, 5),
    0: (0, -3.4, 6), 17: (0, -5, 5.6), 61: (-2.5, -4, 4.2), 291: (2.5, -4, 4.2),
    39: (-1.2, -3.5, 5.6), 269: (1.2, -3.5, 5.6), 181: (-1.2, -4.9, 5.2), 405: (1.2, -4.9, 5.2),
    152: (0, -9, 4.2),
}  # fmt: skip
FACE = np.array([(_STABLE_POINTS | MOUTH)[point] for point in LANDMARKS], float)


def film(moves: dict[int, tuple[float, float, float]], seed: int = 0) -> NDArray[np.float32]:
    """Frames of a face that a camera sees in any pose; in the second half points are moved, cm."""
    rng = np.random.default_rng(seed)
    frames = []
    for frame in range(NUM_FRAMES):
        points = FACE.copy()
        if frame >= NUM_FRAMES // 2:
            for point, move in moves.items():
                points[LANDMARKS.index(point)] += move
        turned = Rotation.from_euler("xyz", rng.normal(0, 0.3, 3)).apply(points)
        frames.append(rng.uniform(10, 40) * turned * (1, -1, -1) + rng.normal(300, 50, 3))
    return np.array(frames, np.float32)


TIMES = np.arange(NUM_FRAMES) / 25
PCM = np.random.default_rng(0).integers(-9000, 9000, 3 * 48_000).astype(np.int16)
FRAMES = film({14: (0, -1, 0)})


def landmark_file(
    time_s: NDArray[np.float64] = TIMES,
    frames: NDArray[np.float32] = FRAMES,
    pcm: NDArray[np.int16] = PCM,
    **header: object,
) -> bytes:
    """Return a file of landmarks, in pixels, and sound; ``header`` replaces its entries."""
    given = {"times": len(time_s), "points": len(LANDMARKS), "sample_rate_hz": 48_000} | header
    text = json.dumps(given).encode()
    body = time_s.astype("<f8").tobytes() + frames.tobytes() + pcm.tobytes()
    return len(text).to_bytes(4, "little") + text + body
