"""Two networks in one search: an early causal one, and a later, better one."""

from functools import cache
from typing import cast

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.acoustic.two_networks import TwoNetworks
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.shared.phones.events import LipPositions, Phone
from tests.live_streams import recognize_live, recognize_together
from tests.unit.test_block_model import FRAMES, HELLO, blocks

pytestmark = [pytest.mark.usefixtures("one_thread")]


@cache
def two_networks() -> TwoNetworks:
    early, late = cast(NeuralModel, load_model()), blocks()
    return TwoNetworks(topology=late.topology, early=early, late=late)


def test_the_newest_frames_have_causal_scores() -> None:
    model = two_networks()
    together, early, late = (part.create_stream() for part in (model, model.early, model.late))
    num_settled = 0
    newest = np.empty((0, model.topology.num_states), np.float32)
    for start in range(0, len(FRAMES), 3):
        chunk = FRAMES[start : start + 3]
        settled = together.score(chunk)
        np.testing.assert_array_equal(settled, late.score(chunk))
        newest = np.concatenate([newest, early.score(chunk)])
        num_settled += len(settled)
        known = len(late.provisional)
        np.testing.assert_array_equal(together.provisional[:known], late.provisional)
        np.testing.assert_array_equal(together.provisional[known:], newest[num_settled + known :])
    assert num_settled + len(together.provisional) >= len(FRAMES) - 2
    np.testing.assert_array_equal(together.score(None), late.score(None))
    assert len(together.provisional) == 0


def events_of(model: AcousticModel, chunk: int = 320) -> list[StreamOutput]:
    lips = lip_predictor_for(model)
    assert lips is not None
    return recognize_live(model, HELLO, chunk, lip_predictor=lips, face_delay_s=0.06)


def test_lip_frames_come_from_the_causal_network() -> None:
    assert lip_predictor_for(blocks()) is None
    frames, expected = (
        [event for event in events_of(model) if isinstance(event, LipPositions)]
        for model in (two_networks(), cast(NeuralModel, load_model()))
    )
    assert len(frames) > 40
    for one, two in zip(frames, expected, strict=True):
        assert (one.time_s, one.delay_s) == (two.time_s, two.delay_s)
        np.testing.assert_array_equal(one.faps, two.faps)


def test_chunks_and_other_sessions_do_not_affect_phones() -> None:
    model = two_networks()
    expected = [event for event in events_of(model) if isinstance(event, Phone)]
    assert len(expected) > 5
    assert [event for event in events_of(model, 777) if isinstance(event, Phone)] == expected
    first = recognize_together(model, [HELLO[1000 * number :] for number in range(3)])[0]
    assert [event for event in first if isinstance(event, Phone)] == expected
