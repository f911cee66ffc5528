"""The neural model: its file, its look-aheads, sessions scored together."""

from pathlib import Path

import numpy as np
import pytest

from services.recognizer.acoustic_model import listen
from services.recognizer.features import LogMel
from services.recognizer.load import load_model, model_path
from services.recognizer.model_file import read_archive, write_archive
from services.recognizer.neural import FORMAT, NUM_INPUTS, NeuralModel
from services.recognizer.pipeline import Recognizer
from shared.audio_file import read_audio
from shared.errors import UserError

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"
HELLO = read_audio(DEMO / "hello-female.wav")[0][:24_000, 0]
LOG_MEL = LogMel().accept_waveform(HELLO)


def neural(look_ahead_ms: float | None = None) -> NeuralModel:
    model = load_model(model_path("neural"), look_ahead_ms=look_ahead_ms)
    assert isinstance(model, NeuralModel)
    return model


def test_every_look_ahead_has_scores_of_its_own() -> None:
    found = {}
    for frames in neural().look_aheads:
        model = neural(10.0 * frames)
        stream = model.stream()
        assert stream.look_ahead_frames == frames
        early = stream.accept(LOG_MEL)
        assert len(early) == len(LOG_MEL) - frames
        found[int(frames)] = np.concatenate([early, stream.finish()])
        assert found[int(frames)].shape == (len(LOG_MEL), model.topology.num_states)
    assert len({scores.tobytes() for scores in found.values()}) == len(found)


def test_a_segment_begins_afresh_and_the_speaker_is_kept() -> None:
    stream = neural().stream()
    first = np.concatenate([stream.accept(LOG_MEL), stream.finish()])
    assert len(stream.finish()) == 0
    second = np.concatenate([stream.accept(LOG_MEL), stream.finish()])
    assert first.shape == second.shape
    assert not np.array_equal(first, second)  # the mean of the speaker has been learnt
    stream.reset()
    again = np.concatenate([stream.accept(LOG_MEL), stream.finish()])
    np.testing.assert_array_equal(again, first)


def test_sessions_that_listen_together_hear_what_each_hears_alone() -> None:
    model = neural()
    sounds = [HELLO, HELLO[8000:], HELLO[:9000], np.zeros(4000, np.float32)]
    alone = []
    for sound in sounds:
        recognizer = Recognizer(model, sample_rate_hz=16_000)
        alone.append(recognizer.accept_waveform(sound) + recognizer.input_finished())
    recognizers = [Recognizer(model, sample_rate_hz=16_000) for _ in sounds]
    heard = [r.hear(sound) for r, sound in zip(recognizers, sounds, strict=True)]
    together = listen(model, heard)
    ends = listen(model, [recognizer.hear_end() for recognizer in recognizers])
    assert [events + end for events, end in zip(together, ends, strict=True)] == alone
    assert alone[0]


def test_saved_and_loaded_scores_are_the_same(tmp_path: Path) -> None:
    model = neural()
    model.save(tmp_path / "model.npz")
    again = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(again.stream().accept(LOG_MEL), model.stream().accept(LOG_MEL))


def test_an_unknown_look_ahead_is_refused() -> None:
    with pytest.raises(UserError, match="look_ahead_ms is 50; give one of 0, 10, 30"):
        neural(50.0)


def test_a_gmm_has_one_look_ahead() -> None:
    model = load_model(model_path("gmm"), look_ahead_ms=10.0)
    assert model.stream().look_ahead_frames == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": np.zeros(100, np.uint8)}, "network cannot be read"),
        ({"look_aheads": np.array([], np.int64)}, "names no look-aheads"),
        ({"look_aheads": np.array([0, -1])}, "look-aheads"),
        ({"look_aheads": np.arange(50)}, "does not run"),
        ({"head": np.array(77)}, "output layer 77"),
        ({"spread": np.zeros(NUM_INPUTS, np.float32)}, "spread"),
        ({"log_prior": np.zeros(7, np.float32)}, "log_prior has shape"),
        ({"prior_mean": np.full(NUM_INPUTS, np.nan, np.float32)}, "no numbers"),
    ],
)
def test_files_are_checked(change: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    arrays = read_archive(model_path("neural")).arrays
    assert str(arrays["format"]) == FORMAT
    write_archive(path, {**arrays, **change})
    with pytest.raises(UserError, match=message):
        load_model(path)


def test_a_network_of_other_states_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    arrays = read_archive(model_path("neural")).arrays
    one_less = {name: arrays[name][:-1] for name in ("log_stay", "log_leave", "log_prior")}
    first_state = np.minimum(arrays["first_state"], len(arrays["log_prior"]) - 1)
    write_archive(path, {**arrays, **one_less, "first_state": first_state})
    with pytest.raises(UserError, match="its network scores"):
        load_model(path)
