"""A recognizer that goes on with a session of a lost one."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.services.recognizer.resumption import GRID_S, WARM_UP_S, Resumption
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.clock import to_samples
from kouxing.shared.phones.events import LipFrame, Phone, Progress, SpeechChange, Waveform
from kouxing.shared.phones.final_time import QUIET_S, FinalTime
from tests.e2e.following import samples_of_file
from tests.live_streams import LiveStream
from tests.system import DEMO

pytestmark = pytest.mark.unit
TOLERANCE_S = 0.03  # of onsets: the networks saw other sound before
CHUNK = 1600  # samples: 100 ms


def phone(index: int, onset_s: float, duration_s: float, *, final: bool = True) -> Phone:
    return Phone(
        index=index,
        symbol="a",
        onset_s=onset_s,
        duration_s=duration_s,
        confidence=1.0,
        final=final,
    )


def final_phones(outputs: list[StreamOutput]) -> list[Phone]:
    return [
        each for each in outputs if isinstance(each, Phone) and each.final and not each.is_withdrawn
    ]


@pytest.fixture(scope="module")
def model() -> AcousticModel:
    return load_live_model("blocks", look_ahead_ms=10)


@pytest.fixture(scope="module")
def samples() -> NDArray[np.float32]:
    return samples_of_file(DEMO / "hello-female.wav")


def joined(outputs: list[list[StreamOutput]]) -> list[StreamOutput]:
    return list(itertools.chain.from_iterable(outputs))


def recognized(
    model: AcousticModel,
    samples: NDArray[np.float32],
    begin: int,
    resumption: Resumption,
    speech_time: int = 0,
) -> list[list[StreamOutput]]:
    """Return the outputs after each chunk from a sample on, and after the end."""
    stream = LiveStream(model, OutputRuleConfig(), speech_time=speech_time)
    outputs = []
    for start in range(begin, len(samples), CHUNK):
        chunk = (start, samples[start : start + CHUNK])
        if start == begin:
            chunk = resumption.on_grid(chunk, 16_000)
        media_time, samples_in = chunk
        outputs.append(stream.feed(samples_in, media_time))
    outputs.append(stream.finish())
    return [resumption.pass_on(each) for each in outputs]


@pytest.fixture(scope="module")
def whole(model: AcousticModel, samples: NDArray[np.float32]) -> list[list[StreamOutput]]:
    """The outputs of a session without a loss."""
    return recognized(model, samples, 0, Resumption(0.0, "sil"))


def known_until(
    whole: list[list[StreamOutput]], lost_s: float
) -> tuple[list[StreamOutput], float, int]:
    """Return what came until a loss, up to when phones are final, and the first sample again."""
    before = joined(whole[: round(lost_s * 10)])
    final = FinalTime()
    for output in before:
        if not isinstance(output, Waveform):
            final.accept(output)
    begin = max(0, round((final.time_s - WARM_UP_S) * 16_000) // CHUNK * CHUNK)
    return before, final.time_s, begin


@pytest.mark.parametrize("lost_s", [2.5, 3.1, 4.0])
def test_the_phones_of_both_recognizers_are_those_of_one(
    model: AcousticModel,
    samples: NDArray[np.float32],
    whole: list[list[StreamOutput]],
    lost_s: float,
) -> None:
    before, final_s, begin = known_until(whole, lost_s)
    assert 0.0 < final_s < lost_s
    after = joined(recognized(model, samples, begin, Resumption(final_s, "sil")))
    expected, got = final_phones(joined(whole)), final_phones(before) + final_phones(after)
    assert [each.symbol for each in got] == [each.symbol for each in expected]
    shifts = [abs(a.onset_s - b.onset_s) for a, b in zip(expected, got, strict=True)]
    assert max(shifts) <= TOLERANCE_S


@pytest.mark.parametrize("lost_s", [2.8, 3.1, 3.4, 4.0, 4.4])
def test_phones_come_as_soon_as_if_nothing_had_been_lost(
    model: AcousticModel,
    samples: NDArray[np.float32],
    whole: list[list[StreamOutput]],
    lost_s: float,
) -> None:
    before, final_s, begin = known_until(whole, lost_s)
    (speech,) = (each for each in before if isinstance(each, SpeechChange) and each.active)
    resumption = Resumption(final_s, "sil")
    after = recognized(model, samples, begin, resumption, to_samples(speech.time_s))
    from_s = final_s + 0.3
    expected = first_chunks(whole[begin // CHUNK :], from_s)
    assert first_chunks(after, from_s) == expected


def first_chunks(outputs: list[list[StreamOutput]], from_s: float) -> list[tuple[str, int]]:
    """Return phones that begin after a time, as they were at first, and with which chunk."""
    seen: set[int] = set()
    found = []
    for number, each in enumerate(outputs):
        for output in each:
            if isinstance(output, Phone) and output.onset_s > from_s and output.index not in seen:
                seen.add(output.index)
                found.append((output.symbol, number))
    return found


def test_what_others_have_said_is_not_said_again() -> None:
    resumption = Resumption(1.0, "sil")
    lips = LipFrame(
        time_s=0.98, delay_s=0.0, faps=np.zeros(28, np.float32), closure=0.0, lip_to_teeth=0.0
    )
    known: list[StreamOutput] = [
        Waveform(time_s=0.0, samples=np.zeros(16_000, np.float32)),
        SpeechChange(active=True, time_s=0.5),
        phone(0, 0.8, 0.3, final=False),
        phone(0, 0.8, 0.3),
        lips,
        Progress(time_s=1.0, level_db=0.0),
    ]
    assert resumption.pass_on(known) == []
    new: list[StreamOutput] = [phone(1, 0.95, 0.2), Progress(time_s=1.02, level_db=0.0)]
    assert resumption.pass_on(new) == [SpeechChange(active=True, time_s=1.0), *new]


def test_sound_is_published_from_the_time_on() -> None:
    sound = Waveform(time_s=0.75, samples=np.arange(8000, dtype=np.float32))
    _, passed = Resumption(1.0, "sil").pass_on([sound])
    assert isinstance(passed, Waveform)
    assert passed.time_s == 1.0
    np.testing.assert_array_equal(passed.samples, np.arange(4000, 8000))


def test_a_phone_that_proves_to_be_known_already_is_withdrawn() -> None:
    resumption = Resumption(1.0, "sil")
    first, guess = phone(0, 0.98, 0.1, final=False), phone(0, 0.8, 0.1, final=False)
    assert resumption.pass_on([first])[1:] == [first]
    assert resumption.pass_on([guess]) == [guess], "it may change once more"
    (last,) = resumption.pass_on([phone(0, 0.8, 0.1)])
    assert isinstance(last, Phone)
    assert last.is_withdrawn


def test_speech_that_began_before_begins_at_the_time() -> None:
    resumption = Resumption(1.0, "sil")
    resumption.pass_on([Progress(time_s=1.02, level_db=0.0)])
    begun = SpeechChange(active=True, time_s=0.9)
    assert resumption.pass_on([begun]) == [SpeechChange(active=True, time_s=1.0)]


@pytest.mark.parametrize("rate_hz", [8000, 16_000, 44_100])
def test_sound_begins_on_the_grid(rate_hz: int) -> None:
    resumption = Resumption(5.0, "sil")
    chunk = np.zeros((rate_hz // 5, 1), np.float32)
    media_time, rest = resumption.on_grid((to_samples(1.0), chunk), rate_hz)
    assert media_time % to_samples(GRID_S) <= 16_000 / rate_hz
    assert len(rest) * 16_000 / rate_hz == pytest.approx(16_000 + 3200 - media_time, abs=2)


def test_phones_are_final_up_to_the_last_one_and_in_silence_up_to_now() -> None:
    final = FinalTime()
    times = []
    for event in (
        Progress(time_s=0.2, level_db=0.0),
        Progress(time_s=2.0, level_db=0.0),
        SpeechChange(active=True, time_s=1.9),
        Progress(time_s=3.0, level_db=0.0),
        phone(0, 2.0, 0.25),
        phone(1, 2.25, 0.25, final=False),
        SpeechChange(active=False, time_s=4.0),
    ):
        final.accept(event)
        times.append(final.time_s)
    quiet_s = 2.0 - QUIET_S
    assert times == [0.0, quiet_s, 1.9, 1.9, 2.25, 2.25, 4.0]
