"""Transparent videos, PNG files and sequences, read back."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from kouxing.services.driver.video.writer import VideoWriter, open_writer, write_picture
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit

PICTURE = np.zeros((48, 64, 4), np.uint8)
PICTURE[10:30, 10:40] = [200, 50, 20, 255]
PICTURE[30:40, 10:40] = [20, 50, 200, 128]


def first_picture(path: Path) -> NDArray[np.uint8]:
    """Decode VP9 with alpha, by libvpx."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        decoder = stream.codec_context
        if decoder.name == "vp9":
            assert stream.metadata["alpha_mode"] == "1"
            decoder = av.CodecContext.create("libvpx-vp9", "r")
        for packet in container.demux(stream):
            for frame in decoder.decode(packet if packet.size else None):
                return np.asarray(frame.to_ndarray(format="rgba"), dtype=np.uint8)
    raise AssertionError("no picture")


@pytest.mark.parametrize("name", ["out.mov", "out.webm"])
def test_transparent_videos_have_alpha(tmp_path: Path, name: str) -> None:
    with VideoWriter(tmp_path / name, 64, 48, 25.0, 16000, transparent=True) as writer:
        for _ in range(5):
            writer.write_image(PICTURE)
            writer.write_sound(np.zeros(640, np.float32))
    got = first_picture(tmp_path / name)
    inner = np.zeros((48, 64), dtype=bool)
    inner[12:28, 12:38] = inner[32:38, 12:38] = inner[:8] = True  # without smoothed edges
    np.testing.assert_allclose(got[inner, 3].astype(int), PICTURE[inner, 3], atol=3)
    np.testing.assert_allclose(got[20, 20].astype(int), [200, 50, 20, 255], atol=6)


@pytest.mark.parametrize("channels", [3, 4])
def test_webp_is_an_animation(tmp_path: Path, channels: int) -> None:
    path = tmp_path / "face.webp"
    with VideoWriter(path, 64, 48, 20.0, 16000, transparent=channels == 4) as writer:
        for number in range(3):
            writer.write_image(np.roll(PICTURE[..., :channels], 4 * number, axis=1))
            writer.write_sound(np.zeros(800, np.float32))
    with Image.open(path) as moving:
        images = [np.asarray(image.convert("RGBA")) for image in ImageSequence.Iterator(moving)]
        assert (len(images), moving.info["loop"], moving.info["duration"]) == (3, 0, 50)
    got = images[2].astype(int)
    np.testing.assert_allclose(got[20, 28], [200, 50, 20, 255], atol=12)
    assert (got[..., 3].min() == 255) == (channels == 3)


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "h264"), ("a.mov", "h264"), ("a.webm", "vp9")]
)
def test_opaque_videos_declare_their_colors(tmp_path: Path, name: str, codec: str) -> None:
    with VideoWriter(tmp_path / name, 64, 48, 25.0, None) as writer:
        for _ in range(5):
            writer.write_image(np.ascontiguousarray(PICTURE[..., :3]))
    with av.open(str(tmp_path / name)) as container:
        assert container.streams.video[0].codec_context.name == codec
        assert not container.streams.audio
        frame = next(container.decode(video=0))
        assert frame.colorspace == 1  # ITU-R BT.709
        np.testing.assert_allclose(
            frame.to_ndarray(format="rgb24")[20, 20].astype(int), [200, 50, 20], atol=8
        )


def test_mp4_cannot_be_transparent(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="MP4 cannot be transparent"):
        VideoWriter(tmp_path / "out.mp4", 64, 48, 25.0, 16000, transparent=True)


@pytest.mark.parametrize("name", ["frames", "face%03d.png"])
def test_writes_a_picture_sequence(tmp_path: Path, name: str) -> None:
    writer = open_writer(tmp_path / name, (64, 48), 25.0, 16000, transparent=True)
    for _ in range(3):
        writer.write_image(PICTURE)
        writer.write_sound(np.zeros(640, np.float32))
    writer.close()
    files = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.png"))
    names = ["frames/00000.png", "frames/00001.png", "frames/00002.png"]
    assert files == (names if name == "frames" else ["face000.png", "face001.png", "face002.png"])
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / files[2])), PICTURE)


@pytest.mark.parametrize(
    ("name", "said"),
    [("out.avi", "ends in"), ("out.png", "number"), ("no/frames", "cannot write")],
)
def test_rejects_invalid_names(tmp_path: Path, name: str, said: str) -> None:
    with pytest.raises(UserError, match=said):
        open_writer(tmp_path / name, (64, 48), 25.0, None)


def test_error_of_an_unwritable_picture(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot write"):
        write_picture(tmp_path / "no" / "out.png", PICTURE)
