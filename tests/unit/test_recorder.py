"""The order in which the driver draws its videos, and how they end."""

from collections.abc import Sized
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.driver import recorder
from kouxing.services.driver.recorder import Recorder
from kouxing.shared.errors import UserError

FRAME = np.zeros(68, "<f4").tobytes()


class FakeRecording:
    """A video of one image per frame, which fails at an image."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.num_queued = 0
        self.is_discarded = False

    def add_frame(self, _time_s: float, _faps: NDArray[np.float32]) -> None:
        self.num_queued += 1

    def step(self) -> bool:
        if self.path.name == "bad":
            raise RuntimeError("the encoder failed")
        self.num_queued -= 1
        return self.num_queued >= 0

    def close(self) -> None:
        pass

    def discard(self) -> None:
        self.is_discarded = True


class RecorderHarness:
    """A recorder of fake videos."""

    def __init__(self) -> None:
        self.reports: list[tuple[object, ...]] = []
        self.recordings: list[FakeRecording] = []
        self.recorder = Recorder(self._make, lambda *report: self.reports.append(report))

    def _make(self, path: Path) -> Any:
        if path.name == "unwritable":
            raise UserError("cannot write unwritable")
        self.recordings.append(FakeRecording(path))
        return self.recordings[-1]

    def begin(self, number: int, key: str, num_frames: int, path: str = "video") -> None:
        self.recorder.begin(number, key, Path(path))
        for frame in range(num_frames):
            self.recorder.add_frame(number, frame / 50, FRAME)

    def draw(self) -> list[object]:
        """Draw what is due; return the numbers of the videos in order."""
        while self.recorder.draw_image():
            pass
        return [report[1] for report in self.reports if report[0] == "image"]


@pytest.fixture
def harness() -> RecorderHarness:
    return RecorderHarness()


def test_every_key_gets_the_same_number_of_images(harness: RecorderHarness) -> None:
    for number in range(3):
        harness.begin(number, "greedy", 2)
    harness.begin(3, "other", 2)
    assert harness.draw() == [0, 3, 1, 3, 2, 0, 1, 2]


def test_completes_a_video_once_its_frames_are_drawn(harness: RecorderHarness) -> None:
    harness.begin(0, "a", 2)
    harness.recorder.end(0)
    harness.recorder.add_frame(0, 9.0, FRAME)
    assert harness.draw() == [0, 0]
    assert harness.reports[-1] == ("written", 0, Path("video"))


def test_an_error_ends_one_video_only(harness: RecorderHarness) -> None:
    harness.begin(0, "a", 1, "bad")
    harness.begin(1, "a", 1, "unwritable")
    harness.begin(2, "a", 1)
    assert harness.draw() == [2]
    assert harness.reports[:2] == [
        ("failed", 1, "cannot write unwritable"),
        ("failed", 0, "the encoder failed"),
    ]
    assert harness.recordings[0].is_discarded


def test_keeps_nothing_of_finished_videos(harness: RecorderHarness) -> None:
    for number, path in enumerate(("video", "bad", "unwritable", "video")):
        harness.begin(number, f"key {number // 2}", 1, path)
        harness.recorder.end(number)
    harness.draw()
    assert len(harness.reports) == 6
    kept = [value for value in vars(harness.recorder).values() if isinstance(value, Sized)]
    assert kept
    assert not any(kept)


def test_ends_a_video_early_when_drawing_is_too_far_behind(
    harness: RecorderHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "MAX_QUEUED_FRAMES", 3)
    harness.begin(0, "a", 2)
    harness.begin(1, "a", 4)
    assert harness.draw() == [0, 1, 0, 1, 1]
    ends = [report[:2] for report in harness.reports if report[0] != "image"]
    assert ends == [("short", 1), ("written", 1)]
