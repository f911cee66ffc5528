"""The commands ``kouxing track`` and ``kouxing adapt``."""

import json
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from kouxing.corpora import lip_tracking
from kouxing.corpora.commands import adapt_app, track_app
from kouxing.corpora.lip_clips import read_clip
from kouxing.services.driver.video.video_writer import VideoWriter
from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.face_landmarks import FACE, landmark_file
from tests.system import DEMO, samples_of_file
from tests.videos import write_video

PICTURES = Path(__file__).parents[1] / "golden"
RUNNER = CliRunner()


def picture(name: str) -> NDArray[np.uint8]:
    return np.array(Image.open(PICTURES / f"render_{name}.png").convert("RGB"))


def run(app: object, *arguments: object) -> None:
    RUNNER.invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)  # type: ignore[arg-type]


def test_tracks_the_lips_in_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nobody = np.zeros((144, 192, 3), np.uint8)
    shut, wide = picture("woman_rest"), picture("woman_a")
    with VideoWriter(tmp_path / "me.mp4", 192, 144, 25.0, 16_000) as writer:
        for image in [*[shut] * 30, *[wide] * 25, *[nobody] * 3]:
            writer.write_image(image)
            writer.write_audio(np.zeros(640, np.float32))
    run(track_app, tmp_path / "me.mp4", "-o", tmp_path / "me")
    clip = read_clip(tmp_path / "me.json")
    assert clip.time_s == pytest.approx(np.arange(58) / 25, abs=0.03)
    assert len(clip.samples) == pytest.approx(58 * 640, abs=2048)
    jaw, lower_lip, depth = (clip.faps[:, MOUTH_FAPS.index(fap)] for fap in (3, 5, 16))
    assert np.abs(lower_lip[:28]).max() < 60
    assert np.median(lower_lip[32:53]) < -100
    assert np.median(jaw[32:53]) > 80
    assert np.isnan(depth).all()
    assert np.isnan(clip.faps[55:]).all()
    older = {path: path.read_bytes() for path in tmp_path.glob("me.*")}
    monkeypatch.setattr(lip_tracking, "_format_tracks", mock.Mock(side_effect=OSError(28, "full")))
    with pytest.raises(UserError, match="the disk is full"):
        run(track_app, tmp_path / "me.mp4", "-o", tmp_path / "me", "--force")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == older


def test_rejects_videos_that_cannot_be_tracked(tmp_path: Path) -> None:
    write_video(tmp_path / "me.mp4")
    (tmp_path / "text.mp4").write_bytes(b"no video")
    write_video(tmp_path / "silent.mp4", has_sound=False)
    for name, message in (
        ("me", "a face was found in only 0 images"),
        ("silent", "must have images and audio"),
        ("text", "this is text, not audio"),
        ("nobody", "no such file"),
    ):
        with pytest.raises(UserError, match=message):
            run(track_app, tmp_path / f"{name}.mp4", "-o", tmp_path / "out")


def test_each_clip_counts_once(tmp_path: Path) -> None:
    clips = (tmp_path / "me.json", tmp_path / "out" / ".." / "me.json")
    with pytest.raises(UserError, match=r"me\.json is named twice"):
        run(adapt_app, *clips, "-o", tmp_path / "me.mouth")


def test_learns_a_mouth_profile_from_a_landmark_file(tmp_path: Path) -> None:
    """The mouth opens with the loudness of the sound."""
    sentences = [samples_of_file(DEMO / f"{name}.wav") for name in ("hello-female", "hello-male")]
    samples = np.concatenate([*sentences, sentences[0]])
    time_s = np.arange(0.02, len(samples) / 16_000 - 0.1, 0.04)
    power = np.convolve(samples**2, np.ones(1600) / 1600, "same")
    loudness = np.sqrt(power[(16_000 * time_s).astype(int)])
    points = np.repeat(FACE[None], len(time_s), axis=0)
    for point in (14, 17, 152, 178, 402):
        points[:, LANDMARKS.index(point), 1] -= 5 * loudness
    pcm = (32767 * samples).astype(np.int16)
    frames = (20 * points * (1, -1, -1)).astype(np.float32)
    seen = landmark_file(time_s, frames, pcm, sample_rate_hz=16_000)
    (tmp_path / "me.landmarks").write_bytes(seen)
    profile, figures = tmp_path / "me.mouth", tmp_path / "me.json"
    run(adapt_app, tmp_path / "me.landmarks", "-o", profile, "--json", figures)
    lips = load_lip_predictor()
    assert lips.with_mouth_profile(profile.read_bytes()).digest != lips.digest
    report = json.loads(figures.read_text(encoding="utf-8"))
    assert report["held_out_s"] == pytest.approx(report["speech_s"] / 4, abs=0.05)
    assert report["after"]["opening"] > report["before"]["opening"] + 0.05
    assert report["before"]["width"] is None
    curve = report["curves"]["opening"]
    assert len(report["curves"]["time_s"]) == len(curve["before"]) == len(curve["tracked"]) > 100
