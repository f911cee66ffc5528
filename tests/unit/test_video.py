"""Videos and pictures, read back: pictures, sound, transparency and colors."""

import os
import resource
import shutil
import signal
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video.film import render_video
from kouxing.services.driver.video.video_renderer import VideoRenderer
from kouxing.services.driver.video.video_writer import VideoWriter, open_writer
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.files.output_file import remove_unfinished


def test_pictures_and_sound_are_in_sync(tmp_path: Path) -> None:
    path = tmp_path / "out.mp4"
    sound = np.zeros(16_000, np.float32)
    sound[8000:8400] = 0.9 * np.sin(np.arange(400) * 0.6)
    with VideoWriter(path, 64, 48, 25.0, 16_000) as writer:
        for number in range(25):
            writer.write_image(np.full((48, 64, 3), 255 * (number >= 12), np.uint8))
            writer.write_audio(sound[640 * number : 640 * (number + 1)])
        assert not path.exists()  # not visible before it is complete
    assert [file.name for file in tmp_path.iterdir()] == ["out.mp4"]
    with av.open(str(path)) as container:
        codecs = [stream.codec_context.name for stream in container.streams]
        assert codecs == ["h264", "aac"]
        assert sum(1 for _ in container.decode(video=0)) == 25
        container.seek(0)
        decoded = [
            float((frame.pts or 0) * (frame.time_base or 0)) + float(index) / 16_000
            for frame in container.decode(audio=0)
            for index in np.flatnonzero(np.abs(frame.to_ndarray().ravel()) > 0.3)
        ]
    assert min(decoded) == pytest.approx(0.5, abs=0.01)


# --- formats ---

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
            writer.write_audio(np.zeros(640, np.float32))
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
            writer.write_audio(np.zeros(800, np.float32))
    with Image.open(path) as moving:
        images = [np.asarray(image.convert("RGBA")) for image in ImageSequence.Iterator(moving)]
        assert (len(images), moving.info["loop"], moving.info["duration"]) == (3, 0, 50)
    got = images[2].astype(int)
    np.testing.assert_allclose(got[20, 28], [200, 50, 20, 255], atol=12)
    assert (got[..., 3].min() == 255) == (channels == 3)


@pytest.mark.parametrize(
    ("name", "codec"), [("A.MP4", "h264"), ("a.mov", "h264"), ("A.WebM", "vp9")]
)
def test_opaque_videos_declare_their_colors(tmp_path: Path, name: str, codec: str) -> None:
    writer = open_writer(tmp_path / name, (64, 48), 25.0, None)
    for _ in range(5):
        writer.write_image(np.ascontiguousarray(PICTURE[..., :3]))
    writer.close()
    with av.open(str(tmp_path / name)) as container:
        assert container.streams.video[0].codec_context.name == codec
        assert not container.streams.audio
        frame = next(container.decode(video=0))
        assert frame.colorspace == 1  # ITU-R BT.709
        np.testing.assert_allclose(
            frame.to_ndarray(format="rgb24")[20, 20].astype(int), [200, 50, 20], atol=8
        )


@pytest.mark.parametrize(
    ("name", "names"),
    [
        ("frames", ["frames/00000.png", "frames/00001.png"]),
        ("face%03d.png", ["face000.png", "face001.png"]),
        ("face%03d.PNG", ["face000.PNG", "face001.PNG"]),
    ],
)
def test_writes_a_picture_sequence(tmp_path: Path, name: str, names: list[str]) -> None:
    writer = open_writer(tmp_path / name, (64, 48), 25.0, 16000, transparent=True)
    for _ in range(2):
        writer.write_image(PICTURE)
        writer.write_audio(np.zeros(640, np.float32))
    writer.close()
    files = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*"))
    assert files == names
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / files[1])), PICTURE)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("out.avi", {}, "ends in"),
        ("out.png", {}, "number"),
        ("out%d%d.png", {}, "one number"),
        ("no/frames", {}, "cannot write"),
        ("no/out.mp4", {}, "cannot write"),
        ("out.mp4", {"transparent": True}, "MP4 cannot be transparent"),
    ],
)
def test_rejects_invalid_settings(
    tmp_path: Path, name: str, settings: dict[str, Any], message: str
) -> None:
    used: dict[str, Any] = {"size": (64, 48), "frame_rate_hz": 25.0, "sample_rate_hz": 16_000}
    with pytest.raises(UserError, match=message):
        open_writer(tmp_path / name, **(used | settings))
    assert not list(tmp_path.iterdir())


# --- unfinished files ---


def test_deletes_the_unfinished_videos_of_killed_processes_only(tmp_path: Path) -> None:
    stale = tmp_path / ".out.mp4.0123abcd.part"
    foreign = tmp_path / ".download.part"
    for path in (stale, foreign):
        path.touch()
    with VideoWriter(tmp_path / "out.mp4", 64, 48, 25.0, None) as writer:
        assert not stale.exists()
        remove_unfinished(tmp_path)
        writer.write_image(np.zeros((48, 64, 3), np.uint8))
    assert {path.name for path in tmp_path.iterdir()} == {"out.mp4", foreign.name}


def test_a_limit_of_the_file_size_leaves_no_file(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (60, 48, 64, 3), np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with pytest.raises(UserError, match=r"'ulimit -f' .*; raise the limit"):  # noqa: PT012
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
        try:
            with VideoWriter(tmp_path / "out.mp4", 64, 48, 25.0, None) as writer:
                for image in images:
                    writer.write_image(image)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_a_video_does_not_replace_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "out.mp4")
    with pytest.raises(UserError, match="it is a pipe or device; use another name"):
        VideoWriter(tmp_path / "out.mp4", 64, 48, 25.0, None)


def test_a_folder_deleted_in_between_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    writer = VideoWriter(folder / "out.mp4", 64, 48, 25.0, None)
    writer.write_image(np.zeros((48, 64, 3), np.uint8))
    shutil.rmtree(folder)
    with pytest.raises(UserError, match=r"out\.mp4"):
        writer.close()
    assert not folder.exists()


# --- recordings of sessions ---


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(Head.load(), 64, 48, samples=0)


def frame(value: float) -> np.ndarray:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[2] = value
    return faps


def test_a_video_without_frames_is_not_written(renderer: Renderer, tmp_path: Path) -> None:
    recording = VideoRenderer(tmp_path / "a.mp4", renderer, 25.0)
    recording.add_audio(0, np.zeros(8000, np.float32))
    with pytest.raises(UserError, match="no frame arrived"):
        recording.close()
    recording.discard()
    assert not any(tmp_path.iterdir())


def test_an_interrupted_video_leaves_no_file(renderer: Renderer, tmp_path: Path) -> None:
    frames = [(number / 25, frame(0)) for number in range(9)]
    interrupt = Mock(side_effect=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        render_video(
            frames, tmp_path / "a.mp4", renderer,
            frame_rate_hz=25.0, samples=None, on_progress=interrupt,
        )  # fmt: skip
    assert not any(tmp_path.iterdir())


def test_fills_missing_sound_and_drops_repeated_sound(renderer: Renderer, tmp_path: Path) -> None:
    recording = VideoRenderer(tmp_path / "a.mp4", renderer, 25.0)
    loud = np.full(8000, 0.5, np.float32)
    recording.add_audio(8000, loud)
    recording.add_audio(12000, loud)
    recording.add_frame(0.0, frame(0))
    recording.step()
    recording.close()
    with av.open(str(tmp_path / "a.mp4")) as film:
        decoded = np.concatenate([f.to_ndarray()[0] for f in film.decode(audio=0)])
    assert len(decoded) == pytest.approx(20000, abs=2100)
    assert np.abs(decoded[:6000]).max() < 0.1
    assert np.abs(decoded[10000:18000]).mean() > 0.3
