"""Audio to phones, live and offline."""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise, zip_longest

import numpy as np
import pytest

from kouxing.corpora.scoring import first_hypothesis, is_emitted
from kouxing.services.recognizer.acoustic.acoustic_model import FIRST, INSIDE
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.live_decoder import LiveDecoder, StreamOutput
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.services.recognizer.search import decoder
from kouxing.services.recognizer.search.decoder import Segment
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.audio_file import read_audio
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.languages import MANDARIN
from tests.live_streams import LiveStream, recognize_live
from tests.system import DEMO

pytestmark = [pytest.mark.unit, pytest.mark.slow]

HELLO = read_audio(DEMO / "hello-female.wav")[0][:, 0]


@cache
def hello_events() -> list[StreamOutput]:
    return recognize_live(load_model(), HELLO, 320)


@cache
def hello_offline() -> list[str]:
    return [phone.symbol for phone in recognize(load_model(), HELLO, 16_000)]


def phones_of(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [output for output in outputs if isinstance(output, Phone)]


def finals(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [phone for phone in phones_of(outputs) if phone.final]


def share_recognized(expected: list[str], recognized: list[str]) -> float:
    """Longest common subsequence over what was expected."""
    table = np.zeros((len(expected) + 1, len(recognized) + 1), int)
    for i, a in enumerate(expected):
        for j, b in enumerate(recognized):
            table[i + 1, j + 1] = max(table[i, j + 1], table[i + 1, j], table[i, j] + (a == b))
    return float(table[-1, -1] / len(expected))


def test_recognizes_most_of_a_clear_sentence() -> None:
    text = "你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。"
    expected = [phone for syllable in MANDARIN.pronounce(text) for phone in syllable]
    live = [phone.symbol for phone in finals(hello_events())]
    assert share_recognized(expected, hello_offline()) > 0.6
    assert share_recognized(expected, live) > 0.6
    assert len(hello_offline()) < 1.3 * len(expected)


def test_silence_and_noise_have_no_phones() -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, 32_000).astype(np.float32)
    for samples in (np.zeros(32_000, np.float32), noise):
        outputs = recognize_live(load_model(), samples, 320)
        assert not any(isinstance(output, Phone | SpeechChange) for output in outputs)
        assert recognize(load_model(), samples, 16_000) == []


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


def test_first_hypotheses_come_soon() -> None:
    stream = LiveStream(load_model())
    delays_s = [
        (start + 160) / 16_000 - phone.onset_s
        for start in range(0, len(HELLO), 160)
        for phone in phones_of(stream.feed(HELLO[start : start + 160]))
        if not phone.final
    ]
    assert len(delays_s) > 40
    assert np.mean(np.array(delays_s) < 0.25) > 0.8


def test_first_durations_are_the_mean_of_phone_and_position() -> None:
    mean_s = load_model().topology.duration_mean_s
    positions = set()
    emitted: dict[int, str] = {}
    events = [event for event in hello_events() if isinstance(event, Phone | SpeechChange)]
    for event, after in zip_longest(events, events[1:]):
        if isinstance(event, SpeechChange):
            emitted.clear()
            continue
        emitted[event.index] = event.symbol
        if is_emitted(event, after):
            position = FIRST if emitted.get(event.index - 1, "sil") == "sil" else INSIDE
            positions.add(position)
            expected_s = float(mean_s[position, MANDARIN.index[event.symbol]])
            assert event.duration_s == pytest.approx(expected_s, abs=1 / 16_000)
    assert positions == {FIRST, INSIDE}


def test_final_hypotheses_are_better_than_first_ones() -> None:
    events = [event for event in hello_events() if isinstance(event, Phone | SpeechChange)]
    first = [phone.symbol for phone in first_hypothesis(events, set())]
    last = [phone.symbol for phone in finals(events)]
    shares = [share_recognized(hello_offline(), symbols) for symbols in (first, last)]
    assert shares[1] > 0.95
    assert shares[1] > shares[0]
    assert abs(len(last) - len(hello_offline())) <= 2


def test_indices_stay_in_order_when_the_search_inserts_or_drops_phones() -> None:
    live = LiveDecoder(load_model().topology, OutputRuleConfig())
    a, b, x = Segment(30, 0, 10), Segment(3, 10, 20), Segment(31, 12, 15)
    assert [phone.index for phone in live._revise([a, b], num_following=1)] == [0, 1]
    assert live._revise([a, b], num_following=1) == []  # nothing new
    inserted = live._revise([a, Segment(3, 10, 12), x, Segment(30, 15, 20)], num_following=1)
    assert [(phone.index, phone.symbol) for phone in inserted] == [(1, "f"), (2, "ei"), (3, "ai")]
    rest = live._revise([Segment(30, 0, 18), Segment(5, 18, 22)], num_following=0)
    assert [phone.index for phone in rest] == [0, 1, 2, 3]
    assert [phone.is_withdrawn for phone in rest] == [True, True, False, False]
    assert [phone.symbol for phone in rest[:2]] == ["sil", "sil"]
    assert rest[2].onset_s + rest[2].duration_s == pytest.approx(rest[3].onset_s)


def test_recognizes_two_stretches_of_speech() -> None:
    pause = np.zeros(24_000, np.float32)
    outputs = recognize_live(load_model(), np.concatenate([HELLO, pause, HELLO]), 320)
    changes = [output.active for output in outputs if isinstance(output, SpeechChange)]
    assert changes == [True, False] * (len(changes) // 2)
    assert len(changes) >= 4
    middle_s = (len(HELLO) + 12_000) / 16_000
    first = [phone.symbol for phone in finals(outputs) if phone.onset_s < middle_s]
    second = [phone.symbol for phone in finals(outputs) if phone.onset_s > middle_s]
    assert share_recognized(first, second) > 0.7


def test_warm_up_compiles_everything_and_changes_no_result() -> None:
    expected = hello_events()
    Recognizer(load_model()).warm_up()
    assert decoder._steps.signatures
    assert decoder._paths_through.signatures
    outputs = recognize_live(load_model(), HELLO, 320)
    assert phones_of(outputs) == phones_of(expected)
