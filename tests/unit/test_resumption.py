"""A recognizer that continues the session of a lost recognizer."""

from collections.abc import Sequence
from itertools import chain

import numpy as np
import pytest
from kouxing_client.messages import Message, Speech

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.services.recognizer.sessions.resumption import (
    GRID_S,
    WARM_UP_S,
    ReplayWindow,
    ResumeFilter,
)
from kouxing.shared.clock import to_samples, to_seconds
from kouxing.shared.phones.events import Phone, SpeechChange, Waveform
from kouxing.shared.wire.events import event_to_message
from kouxing.shared.wire.final_time import MAX_REPORT_DELAY_SAMPLES, FinalTimeTracker
from kouxing.shared.wire.speech import AudioState, Progress
from tests import lips
from tests.live_streams import LiveStream
from tests.system import DEMO, samples_of_file

TOLERANCE_S = 0.03  # of onsets: the networks received other audio before
CHUNK = 1600  # samples: 100 ms
SAMPLES = samples_of_file(DEMO / "hello-female.wav")[:60_000]


def phone(index: int, onset_s: float, duration_s: float, *, final: bool = True) -> Phone:
    return lips.phone(index, "a", onset_s, duration_s, final=final)


def recognize(
    begin: int, resumption: ResumeFilter, speech_time: int = 0
) -> list[list[StreamOutput]]:
    """Return the results after each chunk from a sample on, and after the end."""
    stream = LiveStream(load_model(), speech_time=speech_time)
    outputs = []
    for start in range(begin, len(SAMPLES), CHUNK):
        media_time, samples = resumption.align((start, SAMPLES[start : start + CHUNK]), 16_000)
        outputs.append(stream.feed(samples, media_time))
    outputs.append(stream.finish())
    return [resumption.new_results(results) for results in outputs]


@pytest.fixture(scope="module")
def uninterrupted() -> list[list[StreamOutput]]:
    """The results of a session without a loss."""
    return recognize(0, ResumeFilter(0.0))


def state_at_loss(
    uninterrupted: Sequence[Sequence[StreamOutput]], lost_s: float
) -> tuple[list[StreamOutput], float, int]:
    """Return the results until a loss, the final time, and the first sample to replay."""
    before = list(chain.from_iterable(uninterrupted[: round(lost_s * 10)]))
    final = FinalTimeTracker()
    for output in before:
        if not isinstance(output, Waveform):
            final.update(event_to_message(output))
    begin = max(0, (final.media_time - to_samples(WARM_UP_S)) // CHUNK * CHUNK)
    return before, to_seconds(final.media_time), begin


def final_phones(outputs: Sequence[StreamOutput]) -> list[Phone]:
    phones = [output for output in outputs if isinstance(output, Phone) and output.final]
    return [phone for phone in phones if not phone.is_withdrawn]


@pytest.mark.parametrize("lost_s", [2.0, 3.0])
def test_two_recognizers_emit_the_phones_of_one(
    uninterrupted: list[list[StreamOutput]], lost_s: float
) -> None:
    before, final_s, begin = state_at_loss(uninterrupted, lost_s)
    assert 0.0 < final_s < lost_s
    after = [*chain.from_iterable(recognize(begin, ResumeFilter(final_s)))]
    expected = final_phones([*chain.from_iterable(uninterrupted)])
    phones = final_phones(before) + final_phones(after)
    assert [phone.symbol for phone in phones] == [phone.symbol for phone in expected]
    shifts = [abs(a.onset_s - b.onset_s) for a, b in zip(expected, phones, strict=True)]
    assert max(shifts) <= TOLERANCE_S


@pytest.mark.parametrize("lost_s", [2.3, 3.4])
def test_phones_come_as_early_as_without_a_loss(
    uninterrupted: list[list[StreamOutput]], lost_s: float
) -> None:
    before, final_s, begin = state_at_loss(uninterrupted, lost_s)
    (start_s,) = (
        output.time_s for output in before if isinstance(output, SpeechChange) and output.active
    )
    after = recognize(begin, ResumeFilter(final_s), to_samples(start_s))
    from_s = final_s + 0.3
    expected = first_chunks(uninterrupted[begin // CHUNK :], from_s)
    actual = first_chunks(after, from_s)
    assert [symbol for symbol, _ in actual] == [symbol for symbol, _ in expected]
    assert all(chunk <= last for (_, chunk), (_, last) in zip(actual, expected, strict=True))


def first_chunks(outputs: Sequence[Sequence[StreamOutput]], from_s: float) -> list[tuple[str, int]]:
    """Return the first hypotheses of phones after a time, and the chunk of each."""
    seen: set[int] = set()
    first = []
    for number, results in enumerate(outputs):
        for output in results:
            if isinstance(output, Phone) and output.onset_s > from_s and output.index not in seen:
                seen.add(output.index)
                first.append((output.symbol, number))
    return first


def test_withdraws_a_phone_that_turns_out_to_be_known() -> None:
    resumption = ResumeFilter(1.0)
    first, revised = (phone(0, 0.98, 0.1, final=False), phone(0, 0.8, 0.1, final=False))
    assert resumption.new_results([first])[1:] == [first]
    assert resumption.new_results([revised]) == [revised]  # it may change again
    (last,) = resumption.new_results([phone(0, 0.8, 0.1)])
    assert isinstance(last, Phone)
    assert last.is_withdrawn


def test_aligns_the_first_audio_with_the_grid() -> None:
    resumption = ResumeFilter(5.0)
    samples = np.zeros((8820, 1), np.float32)
    media_time, rest = resumption.align((to_samples(1.0), samples), 44_100)
    assert media_time % to_samples(GRID_S) == 0
    assert len(rest) * 16_000 / 44_100 == pytest.approx(16_000 + 3200 - media_time, abs=2)
    assert resumption.align((7, samples), 44_100) == (7, samples)


RESULTS_AND_FINAL_TIMES: list[tuple[Message, int]] = [
    (Progress(media_time=3200), 0),
    (Progress(media_time=32_000), 32_000 - MAX_REPORT_DELAY_SAMPLES),
    (Progress(media_time=40_000, state=AudioState.SKIPPED), 32_000 - MAX_REPORT_DELAY_SAMPLES),
    (Speech(active=True, media_time=30_400), 30_400),
    (Progress(media_time=48_000), 30_400),
    (event_to_message(phone(0, 2.0, 0.25)), 36_000),
    (event_to_message(phone(1, 2.25, 0.25, final=False)), 36_000),
    (Speech(active=False, media_time=64_000), 64_000),
]


def test_audio_is_droppable_once_no_recognizer_would_replay_it() -> None:
    window, final = ReplayWindow(), FinalTimeTracker()
    for sequence in range(1, 5):
        window.add(sequence, to_samples(sequence))
    for result, final_until in RESULTS_AND_FINAL_TIMES:
        window.update(result, newest_sequence=4)
        final.update(result)
        assert final.media_time == final_until
    assert window.last_droppable_sequence == int(4.0 - WARM_UP_S)
    window.update(Progress(media_time=80_000, state=AudioState.ENDED), newest_sequence=4)
    assert window.last_droppable_sequence == 4
