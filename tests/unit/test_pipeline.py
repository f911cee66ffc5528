"""Audio to phones, live and offline."""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from kouxing.corpora.scoring import count_errors
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.services.recognizer.search import decoder
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.languages import MANDARIN
from tests.live_streams import recognize_live
from tests.system import DEMO

pytestmark = pytest.mark.slow

HELLO = read_audio(DEMO / "hello-female.wav")[0][:, 0]


@cache
def hello_events() -> list[StreamOutput]:
    return recognize_live(load_model(), HELLO, 320)


def phones_of(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [output for output in outputs if isinstance(output, Phone)]


def finals(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [phone for phone in phones_of(outputs) if phone.final]


def test_recognizes_most_of_a_clear_sentence() -> None:
    text = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"
    expected = [phone for syllable in MANDARIN.pronounce(text) for phone in syllable]
    offline = [phone.symbol for phone in recognize(load_model(), HELLO, 16_000)]
    live = [phone.symbol for phone in finals(hello_events())]
    for heard in (offline, live):
        assert count_errors(expected, [phone for phone in heard if phone != "sil"]).rate < 0.4


def test_silence_and_noise_have_no_phones() -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, 32_000).astype(np.float32)
    outputs = recognize_live(load_model(), noise, 320)
    assert not any(isinstance(output, Phone | SpeechChange) for output in outputs)
    assert recognize(load_model(), noise, 16_000) == []


def test_order_and_times_of_emitted_phones() -> None:
    events = [event for event in hello_events() if isinstance(event, Phone | SpeechChange)]
    first, *_, last = events
    assert isinstance(first, SpeechChange)
    assert first.active
    assert isinstance(last, SpeechChange)
    assert not last.active
    known: set[int] = set()
    closed: set[int] = set()
    for phone in phones_of(events):
        assert phone.index not in closed  # a final phone is not emitted again
        assert phone.index <= max(known, default=-1) + 1
        known.add(phone.index)
        assert 0 <= phone.confidence <= 1
        assert phone.duration_s > 0 or phone.is_withdrawn
        assert phone.symbol == "sil" or not phone.is_withdrawn
        if phone.final:
            assert phone.index == len(closed)
            closed.add(phone.index)
    assert closed == known
    done = [phone for phone in finals(events) if not phone.is_withdrawn]
    for one, two in pairwise(done):
        assert one.onset_s + one.duration_s <= two.onset_s + 1e-9
    assert first.time_s <= done[0].onset_s
    assert done[-1].onset_s + done[-1].duration_s <= last.time_s + 1e-9


def test_warm_up_compiles_everything_and_changes_no_result() -> None:
    expected = hello_events()
    Recognizer(load_model()).warm_up()
    assert decoder._steps.signatures
    assert decoder._paths_through.signatures
    outputs = recognize_live(load_model(), HELLO, 320)
    assert phones_of(outputs) == phones_of(expected)
