from collections.abc import Sequence
from itertools import pairwise, zip_longest
from pathlib import Path

import numpy as np
import pytest

from kouxing.corpora.scoring import first_hypothesis, is_emitted
from kouxing.services.recognizer.acoustic.acoustic_model import FIRST, INSIDE
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.recognizer import Emission, Recognizer, warm_up
from kouxing.services.recognizer.search import decoder
from kouxing.services.recognizer.search.decoder import Segment
from kouxing.shared.audio_file import read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, SpeechChange
from tests.languages import MANDARIN

pytestmark = [pytest.mark.unit, pytest.mark.slow]

DEMO = Path(__file__).parents[2] / "shared" / "demo"


@pytest.fixture(scope="module")
def hello() -> np.ndarray:
    return read_audio(DEMO / "hello-female.wav")[0][:, 0]


def feed(recognizer: Recognizer, samples: np.ndarray, chunk: int = 320) -> list[Emission]:
    events: list[Emission] = []
    for start in range(0, len(samples), chunk):
        events += recognizer.accept_waveform(samples[start : start + chunk])
    return events


def run(samples: np.ndarray, chunk: int = 320) -> list[Emission]:
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    return [*feed(recognizer, samples, chunk), *recognizer.input_finished()]


def finals(events: Sequence[Emission]) -> list[Phone]:
    return [event for event in events if isinstance(event, Phone) and event.final]


def phones_in(text: str) -> list[str]:
    return [phone for syllable in MANDARIN.pronounce(text) for phone in syllable]


def share_found(wanted: list[str], heard: list[str]) -> float:
    """Longest common subsequence over what was wanted."""
    table = np.zeros((len(wanted) + 1, len(heard) + 1), int)
    for i, a in enumerate(wanted):
        for j, b in enumerate(heard):
            table[i + 1, j + 1] = max(table[i, j + 1], table[i + 1, j], table[i, j] + (a == b))
    return float(table[-1, -1] / len(wanted))


def test_most_of_a_clear_sentence_is_recognised(hello: np.ndarray) -> None:
    wanted = phones_in("你好，欢迎来到口型。你听到的每一个字，都由我的脸实时说出来。")
    offline = [phone.symbol for phone in recognize(load_model(), hello, 16_000)]
    live = [phone.symbol for phone in finals(run(hello))]
    assert share_found(wanted, offline) > 0.6
    assert share_found(wanted, live) > 0.6
    assert len(offline) < 1.3 * len(wanted)


def test_silence_and_noise_give_nothing() -> None:
    assert run(np.zeros(32_000, np.float32)) == []
    noise = np.random.default_rng(0).normal(0, 0.01, 32_000).astype(np.float32)
    assert run(noise) == []
    assert recognize(load_model(), noise, 16_000) == []


def test_order_and_times_of_emitted_phones(hello: np.ndarray) -> None:
    events = run(hello)
    assert isinstance(events[0], SpeechChange)
    assert events[0].active
    assert isinstance(events[-1], SpeechChange)
    assert not events[-1].active
    phones = [event for event in events if isinstance(event, Phone)]
    known: set[int] = set()
    closed: set[int] = set()
    for phone in phones:
        assert phone.index not in closed  # nothing is emitted of a phone once it is final
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
    assert events[0].time_s <= done[0].onset_s
    assert done[-1].onset_s + done[-1].duration_s <= events[-1].time_s + 1e-9


def test_provisional_phones_come_soon(hello: np.ndarray) -> None:
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    num_early = 0
    provisional = 0
    for start in range(0, len(hello), 160):
        for event in recognizer.accept_waveform(hello[start : start + 160]):
            if isinstance(event, Phone) and not event.final:
                provisional += 1
                num_early += (start + 160) / 16_000 - event.onset_s < 0.25
    assert provisional > 40
    assert num_early > 0.8 * provisional


def test_provisional_durations_are_the_mean_of_phone_and_position(hello: np.ndarray) -> None:
    mean_s = load_model().topology.duration_mean_s
    positions = []
    emitted: dict[int, str] = {}
    events = run(hello)
    for event, after in zip_longest(events, events[1:]):
        if isinstance(event, SpeechChange):
            emitted.clear()
        if not isinstance(event, Phone):
            continue
        emitted[event.index] = event.symbol
        if is_emitted(event, after):
            after_pause = emitted.get(event.index - 1, "sil") == "sil"
            positions.append(FIRST if after_pause else INSIDE)
            wanted = mean_s[positions[-1], MANDARIN.index[event.symbol]]
            assert event.duration_s == pytest.approx(float(wanted))
    assert set(positions) == {FIRST, INSIDE}


def test_phones_are_corrected_until_nothing_more_changes(hello: np.ndarray) -> None:
    whole = [phone.symbol for phone in recognize(load_model(), hello, 16_000)]
    events = run(hello)
    first = [phone.symbol for phone in first_hypothesis(events, set())]
    last = [phone.symbol for phone in finals(events)]
    right = [share_found(whole, symbols) for symbols in (first, last)]
    assert right[1] > 0.95
    assert right[1] > right[0]
    assert abs(len(last) - len(whole)) <= 2


def test_what_the_search_inserts_or_drops_keeps_the_indices_in_order() -> None:
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    a, b, x = Segment(30, 0, 10), Segment(3, 10, 20), Segment(31, 12, 15)
    indices = [phone.index for phone in recognizer._revise([a, b], num_following=1)]
    assert indices == [0, 1]
    assert recognizer._revise([a, b], num_following=1) == []  # nothing new
    inserted = recognizer._revise([a, Segment(3, 10, 12), x, Segment(30, 15, 20)], num_following=1)
    assert [(phone.index, phone.symbol) for phone in inserted] == [(1, "f"), (2, "ei"), (3, "ai")]
    rest = recognizer._revise([Segment(30, 0, 18), Segment(5, 18, 22)], num_following=0)
    assert [phone.index for phone in rest] == [0, 1, 2, 3]
    assert [phone.is_withdrawn for phone in rest] == [True, True, False, False]
    assert [phone.symbol for phone in rest[:2]] == ["sil", "sil"]
    assert rest[2].onset_s + rest[2].duration_s == pytest.approx(rest[3].onset_s)


def test_time_goes_on_and_never_back(hello: np.ndarray) -> None:
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    before = 0.0
    for start in range(0, len(hello), 800):
        recognizer.accept_waveform(hello[start : start + 800])
        heard_s = (start + 800) / 16_000
        assert before <= recognizer.time_s <= heard_s
        assert heard_s - recognizer.time_s < 0.12
        before = recognizer.time_s


def test_reset_gives_the_same_again(hello: np.ndarray) -> None:
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    first = [*feed(recognizer, hello), *recognizer.input_finished()]
    recognizer.reset()
    assert [*feed(recognizer, hello), *recognizer.input_finished()] == first


def test_stereo_at_48_khz(hello: np.ndarray) -> None:
    recognizer = Recognizer(load_model(), sample_rate_hz=48_000, num_channels=2)
    stereo = np.repeat(np.repeat(hello, 3)[:, None], 2, axis=1)
    heard = finals([*feed(recognizer, stereo, 960), *recognizer.input_finished()])
    same = [phone.symbol for phone in finals(run(hello))]
    assert share_found(same, [phone.symbol for phone in heard]) > 0.8


def test_two_stretches_of_speech(hello: np.ndarray) -> None:
    pause = np.zeros(24_000, np.float32)
    events = run(np.concatenate([hello, pause, hello]))
    changes = [event.active for event in events if isinstance(event, SpeechChange)]
    assert changes == [True, False] * (len(changes) // 2)
    assert len(changes) >= 4
    # the second time the voice is known, which may change a phone here and there
    phones = finals(events)
    middle_s = (len(hello) + 12_000) / 16_000
    first = [phone.symbol for phone in phones if phone.onset_s < middle_s]
    second = [phone.symbol for phone in phones if phone.onset_s > middle_s]
    assert share_found(first, second) > 0.7


def test_bad_input_is_refused() -> None:
    with pytest.raises(UserError, match="4000 Hz"):
        Recognizer(load_model(), sample_rate_hz=4_000)
    recognizer = Recognizer(load_model(), sample_rate_hz=16_000)
    with pytest.raises(UserError, match="not finite"):
        recognizer.accept_waveform(np.array([np.inf], np.float32))


def test_warm_up_leaves_nothing_behind(hello: np.ndarray) -> None:
    model = load_model()
    before = [*feed(first := Recognizer(model, sample_rate_hz=16_000), hello)]
    warm_up(model)
    first.reset()
    assert feed(first, hello) == before


def test_warming_up_leaves_nothing_to_compile() -> None:
    warm_up(load_model())
    assert decoder._steps.signatures
    assert decoder._paths_through.signatures
