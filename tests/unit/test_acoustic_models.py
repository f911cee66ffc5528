"""All acoustic models: each frame is scored once, in any chunks, segments and files."""

from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, score_segment
from kouxing.services.recognizer.acoustic.load import SHIPPED, load_model
from kouxing.shared.audio_file import read_audio
from tests.system import DEMO

HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]


@pytest.fixture(scope="module", params=SHIPPED)
def model(request: pytest.FixtureRequest) -> AcousticModel:
    return load_model(request.param)


@pytest.fixture(scope="module")
def frames(model: AcousticModel) -> np.ndarray:
    return model.create_front_end().accept_waveform(HELLO)


@pytest.mark.parametrize("num_frames", [0, 1, 29, 30])
def test_scores_every_frame_once(model: AcousticModel, frames: np.ndarray, num_frames: int) -> None:
    stream = model.create_stream()
    for _ in range(2):
        rows = [*stream.score(frames[:num_frames]), *stream.score(None)]
        assert len(rows) == num_frames
    assert len(stream.score(None)) == 0


def test_scores_come_within_the_look_ahead(model: AcousticModel, frames: np.ndarray) -> None:
    stream = model.create_stream()
    num_settled = 0
    for number in range(1, 60):
        num_settled += len(stream.score(frames[number - 1 : number]))
        assert num_settled >= number - stream.look_ahead_frames
        assert num_settled <= number


def test_chunks_and_earlier_segments_do_not_affect_scores(
    model: AcousticModel, frames: np.ndarray
) -> None:
    expected = score_segment(model, frames)
    stream = model.create_stream()
    stream.score(frames[:77])
    stream.reset()
    assert len(stream.provisional) == 0
    pieces = [stream.score(piece) for piece in np.split(frames, [0, 1, 3, 10, 11, 30])]
    np.testing.assert_array_equal(np.concatenate([*pieces, stream.score(None)]), expected)


@pytest.mark.parametrize("model", ["blocks", "gmm"], indirect=True)
def test_saved_and_loaded_scores_are_the_same(
    model: AcousticModel, frames: np.ndarray, tmp_path: Path
) -> None:
    model.save(tmp_path / "model.npz")  # type: ignore[attr-defined]
    again = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(score_segment(again, frames), score_segment(model, frames))
    assert again.topology.lm_scale == model.topology.lm_scale
