"""Videos contain all pictures and the whole sound."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from kouxing.services.driver.video.writer import VideoWriter
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit


def read(path: Path) -> tuple[int, float, float]:
    """Return the number of pictures, and the durations of pictures and sound, seconds."""
    with av.open(str(path)) as container:
        video, sound = container.streams.video[0], container.streams.audio[0]
        assert video.codec_context.name == "h264"
        assert video.codec_context.pix_fmt == "yuv420p"
        assert sound.codec_context.name == "aac"
        durations = [
            float((stream.duration or 0) * (stream.time_base or 0)) for stream in (video, sound)
        ]
        images = sum(1 for _ in container.decode(video=0))
    return images, durations[0], durations[1]


def test_pictures_and_sound_are_in_sync(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    with VideoWriter(path, 64, 48, 25.0, 16000) as writer:
        for number in range(30):
            writer.write_image(np.full((48, 64, 3), number * 8, np.uint8))
            writer.write_sound(np.zeros(640, np.float32))
        assert not path.exists()  # not visible before it is complete
    images, picture_s, sound_s = read(path)
    assert images == 30
    assert picture_s == pytest.approx(1.2, abs=0.001)
    assert sound_s == pytest.approx(1.2, abs=0.065)  # whole AAC blocks
    assert [file.name for file in tmp_path.iterdir()] == ["out.mp4"]


def test_sound_starts_with_the_picture(tmp_path: Path) -> None:
    path = tmp_path / "click.mp4"
    sound = np.zeros(16000, np.float32)
    sound[8000:8400] = 0.9 * np.sin(np.arange(400) * 0.6)
    with VideoWriter(path, 64, 48, 25.0, 16000) as writer:
        for number in range(25):
            writer.write_image(np.full((48, 64, 3), 255 * (number >= 12), np.uint8))
        writer.write_sound(sound)
    with av.open(str(path)) as container:
        heard = []
        for frame in container.decode(audio=0):
            start = float((frame.pts or 0) * (frame.time_base or 0))
            loud = np.flatnonzero(np.abs(frame.to_ndarray().ravel()) > 0.3)
            heard += [start + float(index) / 16000 for index in loud]
    assert min(heard) == pytest.approx(0.5, abs=0.01)


def test_an_exception_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> None:
        with VideoWriter(tmp_path / "out.mp4", 64, 48, 25.0, 16000) as writer:
            writer.write_image(np.zeros((48, 64, 3), np.uint8))
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", ["no/out.mp4", "."])
def test_unwritable_path(tmp_path: Path, path: str) -> None:
    with pytest.raises(UserError, match="cannot write"):
        VideoWriter(tmp_path / path, 64, 48, 25.0, 16000)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("size", "frame_rate_hz", "sample_rate_hz", "said"),
    [
        ((63, 48), 25.0, 16000, "even"),
        ((64, 48), 0.0001, 16000, "frame rate"),
        ((64, 48), 25.0, 17000, "does not support"),
    ],
)
def test_rejects_invalid_settings(
    tmp_path: Path, size: tuple[int, int], frame_rate_hz: float, sample_rate_hz: int, said: str
) -> None:
    with pytest.raises(UserError, match=said):
        VideoWriter(tmp_path / "out.mp4", *size, frame_rate_hz, sample_rate_hz)
    assert not list(tmp_path.iterdir())
