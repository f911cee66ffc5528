"""A video of a tracked clip next to the lip models."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile

from kouxing.evaluation.lips.clip_video import film_clip, tracked_frames
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.lips import JAW, WIDTH, clip_of

pytestmark = pytest.mark.unit


def test_interpolates_tracked_lips() -> None:
    faps = np.full((3, len(MOUTH_FAPS)), np.nan)
    faps[:, JAW] = 0.0, np.nan, 100.0
    frames = tracked_frames(clip_of(np.array([0.0, 0.1, 0.2]), faps), np.array([0.05, 0.1, 0.9]))
    mouth = frames[:, np.array(MOUTH_FAPS) - 1]
    np.testing.assert_allclose(mouth[:, JAW], [25.0, 50.0, 100.0])
    assert not mouth[:, WIDTH].any()
    faps[:, WIDTH] = -50.0
    frames = tracked_frames(clip_of(np.array([0.0, 0.1, 0.2]), faps), np.array([0.05]))
    assert frames[0, [5, 52]].tolist() == [-50.0, -50.0], "outer lips follow the inner ones"


def test_the_last_face_has_the_tracked_lips(tmp_path: Path) -> None:
    (tmp_path / "one.json").write_text(json.dumps({"language": "en", "licence": "MIT"}))
    (tmp_path / "one.csv").write_text("t,F3_open_jaw,F5_raise_b_midlip\n0,500,-900\n")
    soundfile.write(tmp_path / "one.flac", np.zeros(1600), 16_000)
    film_clip(tmp_path, "one", tmp_path / "one.mp4")
    with av.open(str(tmp_path / "one.mp4")) as video:
        image = next(video.decode(video=0)).to_ndarray(format="rgb24").astype(int)
        assert len(video.streams.audio) == 1
    visemes, learnt, ferguson, tracked = np.split(image[:300], 4, axis=1)
    assert np.abs(learnt - visemes).max() < 60, "both are silent"
    assert np.abs(learnt - ferguson).max() < 60, "both are silent"
    assert np.abs(learnt - tracked).max() > 120
    with pytest.raises(UserError, match="no clip is named two"):
        film_clip(tmp_path, "two", tmp_path / "two.mp4")
