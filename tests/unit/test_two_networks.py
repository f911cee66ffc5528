"""Two networks in one search: the causal one is early, the other one knows better."""

from functools import cache
from typing import cast

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, run_scoring_tasks
from kouxing.services.recognizer.acoustic.load import load_model, with_early_network
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.acoustic.two_networks import TwoNetworks
from kouxing.services.recognizer.lips import lips_for
from kouxing.services.recognizer.speech_scores import FrameScores, SpeechScores
from kouxing.services.recognizer.stream import SpeechStream, StreamOutput
from kouxing.shared.phones.events import LipFrame, Phone
from tests.unit.test_block_model import FRAMES, HELLO, blocks

pytestmark = [pytest.mark.unit, pytest.mark.usefixtures("one_thread")]


@cache
def two_networks() -> TwoNetworks:
    return cast(TwoNetworks, with_early_network(blocks()))


def test_a_model_that_is_early_itself_stays_alone() -> None:
    neural = load_model()
    assert with_early_network(neural) is neural


def test_the_newest_frames_have_the_causal_scores() -> None:
    model = two_networks()
    together, early, late = model.stream(), model.early.stream(), model.late.stream()
    num_settled = 0
    newest = np.empty((0, model.topology.num_states), np.float32)
    for start in range(0, len(FRAMES), 3):
        chunk = FRAMES[start : start + 3]
        settled = together.accept(chunk)
        np.testing.assert_array_equal(settled, late.accept(chunk))
        newest = np.concatenate([newest, early.accept(chunk)])
        num_settled += len(settled)
        known = len(late.provisional)
        np.testing.assert_array_equal(together.provisional[:known], late.provisional)
        np.testing.assert_array_equal(together.provisional[known:], newest[num_settled + known :])
    assert num_settled + len(together.provisional) >= len(FRAMES) - 2
    np.testing.assert_array_equal(together.finish(), late.finish())
    assert len(together.provisional) == 0


def events_of(model: AcousticModel, chunk: int = 320) -> list[StreamOutput]:
    lips = lips_for(model)
    assert lips is not None
    stream = SpeechStream(model, lips=lips, face_delay_s=0.06)
    pieces = np.split(HELLO, range(chunk, len(HELLO), chunk))
    events = [event for piece in pieces for event in stream.accept_waveform(piece)]
    return events + stream.input_finished()


def test_the_lips_are_those_of_the_causal_network() -> None:
    assert lips_for(blocks()) is None
    found, expected = (
        [event for event in events_of(model) if isinstance(event, LipFrame)]
        for model in (two_networks(), cast(NeuralModel, load_model()))
    )
    assert len(found) > 40
    for one, two in zip(found, expected, strict=True):
        assert (one.time_s, one.delay_s) == (two.time_s, two.delay_s)
        np.testing.assert_array_equal(one.faps, two.faps)


@pytest.mark.parametrize("chunk", [160, 777])
def test_provisional_scores_are_the_same_in_any_chunks(chunk: int) -> None:
    def scores_of(pieces: list[np.ndarray]) -> list[FrameScores]:
        scores = SpeechScores(two_networks(), 16_000)
        found = []
        for piece in pieces:
            found += run_scoring_tasks(two_networks(), [scores.process(piece)])[0]
        found += run_scoring_tasks(two_networks(), [scores.finish()])[0]
        return [event for event in found if isinstance(event, FrameScores)]

    expected = scores_of([HELLO])
    found = scores_of(np.split(HELLO, range(chunk, len(HELLO), chunk)))
    assert len(found) > 40
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.settled, two.settled)
        np.testing.assert_array_equal(one.provisional, two.provisional)


def test_phones_are_the_same_in_any_chunks_and_any_company() -> None:
    model = two_networks()
    expected = [event for event in events_of(model) if isinstance(event, Phone)]
    assert len(expected) > 5
    assert [event for event in events_of(model, 777) if isinstance(event, Phone)] == expected
    streams = [SpeechStream(model) for _ in range(3)]
    tasks = [stream.process([(0, HELLO[1000 * number :])]) for number, stream in enumerate(streams)]
    first = run_scoring_tasks(model, tasks)[0] + streams[0].input_finished()
    assert [event for event in first if isinstance(event, Phone)] == expected
