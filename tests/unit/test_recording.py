from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video.recording import Recording
from kouxing.shared.face.faps import NUM_FAPS

pytestmark = pytest.mark.unit


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(Head.load(), 64, 48, samples=0)


def frame(value: float) -> np.ndarray:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[2] = value
    return faps


def test_images_follow_media_time_at_any_frame_rate(renderer: Renderer, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.mp4", renderer, 25.0)
    recording.add_sound(0, np.zeros(16000, np.float32))
    for number in range(31):
        recording.add_frame(number / 30, frame(number))
    while recording.step():
        pass
    recording.close()
    assert recording.num_images == 26
    assert recording.duration_s == pytest.approx(26 / 25)
    with av.open(str(tmp_path / "a.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 26


def test_fills_missing_sound_and_drops_repeated_sound(renderer: Renderer, tmp_path: Path) -> None:
    recording = Recording(tmp_path / "a.mp4", renderer, 25.0)
    loud = np.full(8000, 0.5, np.float32)
    recording.add_sound(8000, loud)
    recording.add_sound(12000, loud)
    recording.add_frame(0.0, frame(0))
    recording.step()
    recording.close()
    with av.open(str(tmp_path / "a.mp4")) as film:
        heard = np.concatenate([f.to_ndarray()[0] for f in film.decode(audio=0)])
    assert len(heard) == pytest.approx(20000, abs=2100)
    assert np.abs(heard[:6000]).max() < 0.1
    assert np.abs(heard[10000:18000]).mean() > 0.3
