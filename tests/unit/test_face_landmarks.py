"""From landmarks to FAPs, and files of landmarks."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from kouxing.corpora.face_mesh import FaceMesh
from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS, compute_mouth_faps
from kouxing.services.mouth_profiles.landmark_file import parse_landmark_file
from kouxing.services.recognizer.lips.lip_predictor import LIP_FAPS
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.face_landmarks import NUM_FRAMES, TIMES, film, landmark_file

QUIET = np.full(NUM_FRAMES, -60.0)


def fap(values: NDArray[np.float64], number: int) -> float:
    return float(np.median(values[NUM_FRAMES // 2 :, MOUTH_FAPS.index(number)]))


def levels(speaking_db: float = -20.0) -> NDArray[np.float64]:
    return np.where(np.arange(NUM_FRAMES) < NUM_FRAMES // 2, -60.0, speaking_db)


@pytest.mark.parametrize(
    ("point", "move", "number", "expected"),
    [
        (152, (0, -1, 0), 3, 512),
        (13, (0, 0.5, 0), 4, -256),
        (14, (0, -1, 0), 5, -512),
        (308, (0.5, 0, 0), 6, 102.4),
        (78, (0.5, 0, 0), 7, -102.4),
        (39, (0, 1, 0), 56, -512),
    ],
)
def test_the_motion_of_a_point_is_its_fap_in_any_head_pose(
    point: int, move: tuple[float, float, float], number: int, expected: float
) -> None:
    faps = compute_mouth_faps(film({point: move}), levels())
    assert fap(faps, number) == pytest.approx(expected, abs=1.0)
    others = [
        other for other in MOUTH_FAPS if other not in (number, *range(12, 18), *range(44, 48))
    ]
    assert max(abs(fap(faps, other)) for other in others) < 1.0
    depths = [MOUTH_FAPS.index(other) for other in (14, 16, 17)]
    assert np.isnan(faps[:, depths]).all()


def test_the_neutral_face_is_silent_and_closed_or_the_most_closed() -> None:
    # with -levels() the mouth is open in silence: those frames are not among the closed ones
    for level_db in (levels(), QUIET, -levels()):
        assert fap(compute_mouth_faps(film({14: (0, -1, 0)}), level_db), 5) == pytest.approx(
            -512, abs=1
        )


def test_rejects_landmarks_that_form_no_face() -> None:
    with pytest.raises(UserError, match="coincide"):
        compute_mouth_faps(np.zeros((NUM_FRAMES, len(LANDMARKS), 3)), QUIET)
    with pytest.raises(UserError, match="upright face"):
        compute_mouth_faps(film({13: (0, 5, 0), 14: (0, 5, 0)})[NUM_FRAMES // 2 :], QUIET[::2])


CONTENT = landmark_file()
HEADER_BYTES = int.from_bytes(CONTENT[:4], "little")


def test_parses_a_landmark_file() -> None:
    filmed = parse_landmark_file(CONTENT)
    np.testing.assert_array_equal(filmed.frame_s, TIMES)
    assert filmed.lip_track[:, LIP_FAPS.index(5)].min() == pytest.approx(-512, abs=2)
    assert len(filmed.samples) == pytest.approx(3 * 16_000, abs=2)


def replaced(at: int, part: bytes) -> bytes:
    return CONTENT[: 4 + HEADER_BYTES + at] + part + CONTENT[4 + HEADER_BYTES + at + len(part) :]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a landmark file"),
        (b"\xff\xff\xff\xff" + CONTENT[4:], "not a landmark file"),
        (CONTENT[: 4 + HEADER_BYTES], "truncated"),
        (landmark_file(times=2**60), "truncated"),
        (landmark_file(times=49), "only 49 frames"),
        (landmark_file(points=468), "468 landmarks"),
        (landmark_file(sample_rate_hz=4000), "4000 Hz"),
        (b"\x04\x00\x00\x00null" + CONTENT[4 + HEADER_BYTES :], "integers"),
        (replaced(8, np.float64(np.nan).tobytes()), "times"),
        (replaced(8 * NUM_FRAMES, np.float32(np.nan).tobytes()), "pixels"),
        (CONTENT[: 4 + HEADER_BYTES + NUM_FRAMES * (8 + 12 * 43) + 20], "second of audio"),
    ],
)
def test_rejects_a_broken_landmark_file(content: bytes, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_landmark_file(content)


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
