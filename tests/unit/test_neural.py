"""The neural model: its look-aheads, its segments and its file."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic import neural as neural_module
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import read_archive
from kouxing.services.recognizer.acoustic.neural import FORMAT, NeuralModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from tests.system import DEMO

pytestmark = pytest.mark.slow

HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
FRAMES = WhisperMel().accept_waveform(HELLO)


@cache
def neural(look_ahead_ms: float | None = None) -> NeuralModel:
    model = load_model(model_path("neural"), look_ahead_ms=look_ahead_ms)
    assert isinstance(model, NeuralModel)
    return model


def scores_of(model: AcousticModel, frames: np.ndarray) -> np.ndarray:
    stream = model.create_stream()
    return np.concatenate([stream.score(frames), stream.score(None)])


def test_scores_do_not_depend_on_frames_after_the_look_ahead() -> None:
    model = neural(30.0)
    other = FRAMES.copy()
    other[50:] += 0.5
    one, two = scores_of(model, FRAMES), scores_of(model, other)
    same = (one == two).all(axis=1)
    assert same[:47].all()
    assert not same[47:].any()


def test_long_speech_restarts_the_table_with_an_empty_past(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = neural(10.0)
    whole = scores_of(model, FRAMES)
    monkeypatch.setattr(neural_module, "MAX_POSITIONS", 20)
    short = scores_of(model, FRAMES)
    assert short.shape == whole.shape
    np.testing.assert_array_equal(short[:41], whole[:41])
    assert not np.array_equal(short[41:43], whole[41:43])
    later = FRAMES.copy()
    later[:38] = 0.3  # frames that only precede the restart
    np.testing.assert_array_equal(scores_of(model, later)[41:81], short[41:81])


def test_rejects_an_unknown_look_ahead() -> None:
    with pytest.raises(UserError, match="no look-ahead of 50 ms; choose 10, 30"):
        neural(50.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": np.zeros(100, np.uint8)}, "network cannot be read"),
        ({"look_aheads": np.array([], np.int64)}, "has no look-aheads"),
        ({"look_aheads": np.array([1, 0])}, "look-aheads"),
        ({"look_aheads": np.arange(1, 50)}, "its network scores"),
        ({"output_layer": np.array(77)}, "output layer 77"),
    ],
)
def test_rejects_a_file_with_bad_arrays(
    change: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.npz"
    arrays = read_archive(model_path("neural")).arrays
    assert str(arrays["format"]) == FORMAT
    np.savez(path, allow_pickle=False, **{**arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)
