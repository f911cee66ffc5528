"""One session's audio to sound events: gaps, flushes, chunks, and times in whole samples."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import run_scoring_tasks
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lip_source import delay_for
from kouxing.services.recognizer.stream import (
    MAX_JITTER,
    SILENT_DB,
    Chunk,
    SpeechStream,
    StreamOutput,
    Waveform,
)
from kouxing.shared.phones.events import (
    EndOfSound,
    LipFrame,
    Phone,
    Progress,
    SoundEvent,
    SpeechChange,
)
from kouxing.shared.wire.events import message_of
from kouxing.shared.wire.message import Message
from tests.e2e.following import samples_of_file
from tests.made_up_lips import JAW, LoudLips
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit

MODEL = load_model()
SAMPLES = samples_of_file(VOWELS_FILE)
RATE_HZ = 16_000


def events_of(outputs: Sequence[StreamOutput]) -> list[SoundEvent]:
    return [output for output in outputs if not isinstance(output, Waveform)]


def sound_of(outputs: Sequence[StreamOutput]) -> NDArray[np.float32]:
    return np.concatenate([each.samples for each in outputs if isinstance(each, Waveform)])


def process(stream: SpeechStream, *chunks: Chunk) -> list[StreamOutput]:
    return run_scoring_tasks(MODEL, [stream.process(chunks)])[0]


def whole(samples: NDArray[np.float32]) -> list[StreamOutput]:
    stream = SpeechStream(MODEL)
    return stream.accept_waveform(samples) + stream.input_finished()


def phones_of(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [output for output in outputs if isinstance(output, Phone)]


def test_times_are_whole_samples_and_progress_comes_every_20_ms() -> None:
    outputs = whole(SAMPLES[:-7])
    times = []
    for event in events_of(outputs):
        times += [event.onset_s, event.duration_s] if isinstance(event, Phone) else [event.time_s]
    samples = np.array(times) * RATE_HZ
    np.testing.assert_allclose(samples, np.rint(samples), atol=1e-6)
    progress = [event for event in outputs if isinstance(event, Progress)]
    num_slices = (len(SAMPLES) - 7) // 320
    np.testing.assert_array_equal(
        [event.time_s for event in progress[:-1]], np.arange(1, num_slices + 1) * 320 / RATE_HZ
    )
    assert progress[-1] == Progress(time_s=(len(SAMPLES) - 7) / RATE_HZ, level_db=SILENT_DB)
    assert outputs[-1] == EndOfSound(time_s=(len(SAMPLES) - 7) / RATE_HZ)
    assert len(phones_of(outputs)) > 5


@pytest.mark.parametrize(("rate_hz", "size"), [(16_000, 97), (44_100, 1021)])
def test_chunks_do_not_matter(rate_hz: int, size: int) -> None:
    one, many = (SpeechStream(MODEL, sample_rate_hz=rate_hz) for _ in range(2))
    expected = one.accept_waveform(SAMPLES) + one.input_finished()
    outputs: list[StreamOutput] = []
    for begin in range(0, len(SAMPLES), size):
        outputs += many.accept_waveform(SAMPLES[begin : begin + size])
    outputs += many.input_finished()
    assert events_of(outputs) == events_of(expected)
    np.testing.assert_array_equal(sound_of(outputs), to_16_khz(SAMPLES, rate_hz))


def test_a_gap_ends_the_speech_and_recognition_goes_on_behind_it() -> None:
    alone = phones_of(whole(SAMPLES))
    stream = SpeechStream(MODEL)
    gap = len(SAMPLES) + MAX_JITTER + 1
    outputs = process(stream, (0, SAMPLES), (gap, SAMPLES)) + stream.input_finished()
    assert stream.num_gaps == 1
    phones = phones_of(outputs)
    num_before = 1 + max(phone.index for phone in alone)
    first, second = (
        [phone for phone in phones if (phone.index >= num_before) == behind]
        for behind in (False, True)
    )
    assert first == alone
    assert [(p.symbol, p.final, p.duration_s) for p in second] == [
        (p.symbol, p.final, p.duration_s) for p in alone
    ]
    shifts = [b.onset_s - a.onset_s for a, b in zip(alone, second, strict=True)]
    np.testing.assert_allclose(shifts, gap / RATE_HZ)
    states = [event.active for event in outputs if isinstance(event, SpeechChange)]
    assert states[0]
    assert not states[-1]
    assert all(before != after for before, after in itertools.pairwise(states))
    assert sum(isinstance(event, EndOfSound) for event in outputs) == 1


def test_jitter_is_no_gap() -> None:
    stream = SpeechStream(MODEL)
    outputs = process(stream, (0, SAMPLES[:8000]), (8000 + MAX_JITTER, SAMPLES[8000:]))
    outputs += stream.input_finished()
    assert stream.num_gaps == 0
    assert events_of(outputs) == events_of(whole(SAMPLES))


def test_a_flush_ends_the_speech_and_drops_it() -> None:
    stream = SpeechStream(MODEL)
    spoken = phones_of(stream.accept_waveform(SAMPLES[:16_000]))
    assert spoken
    assert stream.flush() == [SpeechChange(active=False, time_s=1.0)]
    assert stream.flush() == []
    rest = stream.accept_waveform(SAMPLES) + stream.input_finished()
    later = phones_of(rest)
    assert min(phone.index for phone in later) == 1 + max(phone.index for phone in spoken)
    assert [(p.symbol, p.duration_s) for p in later] == [
        (p.symbol, p.duration_s) for p in phones_of(whole(SAMPLES))
    ]
    assert min(phone.onset_s for phone in later) > 1.0
    assert rest[-1] == EndOfSound(time_s=1.0 + len(SAMPLES) / RATE_HZ)


def test_a_session_may_begin_at_any_media_time() -> None:
    stream = SpeechStream(MODEL)
    outputs = process(stream, (50 * RATE_HZ, SAMPLES[:4000]))
    assert stream.num_gaps == 0
    assert isinstance(outputs[0], Waveform)
    assert outputs[0].time_s == 50.0
    assert stream.media_time == stream.next_media_time == 50 * RATE_HZ + 4000


def with_lips(face_delay_s: float = 0.1, rate_hz: int = RATE_HZ) -> SpeechStream:
    return SpeechStream(MODEL, sample_rate_hz=rate_hz, lips=LoudLips(), face_delay_s=face_delay_s)


def lips_of(outputs: Sequence[StreamOutput]) -> list[LipFrame]:
    return [output for output in outputs if isinstance(output, LipFrame)]


def messages_of(outputs: Sequence[StreamOutput]) -> list[Message]:
    """What can be compared: events with arrays cannot."""
    return [message_of(event) for event in events_of(outputs)]


def test_sound_may_begin_within_speech() -> None:
    within_er = SAMPLES[8_000:12_000]  # speech from its first block, before any whole position
    outputs = SpeechStream(MODEL).accept_waveform(within_er)
    changes = [output for output in outputs if isinstance(output, SpeechChange)]
    assert [change.active for change in changes] == [True]
    assert changes[0].time_s < 0.04


def test_lips_come_every_20_ms_while_somebody_speaks_and_in_time() -> None:
    stream = with_lips()
    sound = np.concatenate([np.zeros(RATE_HZ, np.float32), SAMPLES, np.zeros(RATE_HZ, np.float32)])
    known_s, speech_s, frames, is_live = 0.0, [], [], []
    for begin in range(0, len(sound), 320):
        outputs = stream.accept_waveform(sound[begin : begin + 320])
        known_s = (begin + 320) / RATE_HZ
        speech_s += [each.time_s for each in outputs if isinstance(each, SpeechChange)]
        new = lips_of(outputs)
        is_live.append(len(new) == 1)
        # the newest comes with its sound, not 20 ms later
        assert all(each.time_s + each.delay_s <= known_s for each in new)
        assert not new or new[-1].time_s + new[-1].delay_s > known_s - 0.02
        frames += new
    assert sum(is_live) > 50
    times = np.array([frame.time_s for frame in frames])
    samples = times * RATE_HZ
    np.testing.assert_allclose(samples, np.rint(samples), atol=1e-6)
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    assert times[0] > speech_s[0] - 0.1 - 1e-6
    assert speech_s[-1] - 0.15 < times[-1] < speech_s[-1]
    assert all(frame.delay_s == 0.085 for frame in frames)
    jaw = np.array([frame.faps[JAW] for frame in frames])
    assert jaw.max() > jaw.min() + 20.0


@pytest.mark.parametrize("rate_hz", [16_000, 44_100, 48_000])
@pytest.mark.parametrize("before_s", [0.5, 0.51, 0.537])
def test_a_face_frame_that_is_due_finds_lips_that_know_the_sound_up_to_5_ms_before(
    rate_hz: int, before_s: float
) -> None:
    """Wherever the voice begins, and with the resampler's delay."""
    silence = np.zeros(round(before_s * rate_hz), np.float32)
    sound = np.concatenate([silence, resampled(SAMPLES, rate_hz)])
    newest_s, is_speaking, behind_s = 0.0, False, []
    for event in events_of(with_lips(rate_hz=rate_hz).accept_waveform(sound)):
        if isinstance(event, LipFrame):
            newest_s = event.time_s + event.delay_s
        elif isinstance(event, SpeechChange):
            is_speaking = event.active
        elif isinstance(event, Progress) and is_speaking:
            behind_s.append(event.time_s - newest_s)
    assert len(behind_s) > 50
    np.testing.assert_allclose(behind_s, 0.005, atol=1e-9)


def resampled(samples: NDArray[np.float32], rate_hz: int) -> NDArray[np.float32]:
    """Bring 16 kHz to another rate, well enough for a voice detector."""
    times_s = np.arange(len(samples) * rate_hz // RATE_HZ) / rate_hz
    here_s = np.arange(len(samples)) / RATE_HZ
    return np.interp(times_s, here_s, samples).astype(np.float32)


def test_lips_change_nothing_else() -> None:
    stream = with_lips()
    outputs = stream.accept_waveform(SAMPLES) + stream.input_finished()
    rest = [event for event in events_of(outputs) if not isinstance(event, LipFrame)]
    assert rest == events_of(whole(SAMPLES))
    assert lips_of(outputs)


@pytest.mark.parametrize(("times", "size"), [(1, 97), (3, 1021)])
def test_chunks_do_not_matter_to_lips(times: int, size: int) -> None:
    one, many = (with_lips(rate_hz=times * RATE_HZ) for _ in range(2))
    sound = np.repeat(SAMPLES, times)
    expected = one.accept_waveform(sound) + one.input_finished()
    outputs: list[StreamOutput] = []
    for begin in range(0, len(sound), size):
        outputs += many.accept_waveform(sound[begin : begin + size])
    outputs += many.input_finished()
    assert messages_of(outputs) == messages_of(expected)
    assert lips_of(outputs)


def test_sessions_scored_together_have_the_lips_that_each_has_alone() -> None:
    sounds = [SAMPLES, SAMPLES[8000:], SAMPLES[:9000]]
    alone = []
    for sound in sounds:
        stream = with_lips()
        alone.append(messages_of(process(stream, (0, sound))))
    streams = [with_lips() for _ in sounds]
    tasks = [stream.process([(0, sound)]) for stream, sound in zip(streams, sounds, strict=True)]
    assert [messages_of(each) for each in run_scoring_tasks(MODEL, tasks)] == alone


def test_lips_go_on_behind_a_gap() -> None:
    stream = with_lips()
    gap = len(SAMPLES) + MAX_JITTER + 1
    outputs = process(stream, (0, SAMPLES), (gap, SAMPLES)) + stream.input_finished()
    before, after = (
        [each for each in lips_of(outputs) if (each.time_s >= gap / RATE_HZ) == behind]
        for behind in (False, True)
    )
    assert len(before) == len(after)
    for one, other in zip(before, after, strict=True):
        assert other.time_s - one.time_s == pytest.approx(gap / RATE_HZ)
        np.testing.assert_array_equal(one.faps, other.faps)


@pytest.mark.parametrize(
    ("face_delay_s", "expected_s"),
    [(0.0, -0.005), (0.02, -0.005), (0.025, -0.005), (0.04, 0.025), (0.1, 0.085), (0.16, 0.145)],
)
def test_the_longest_delay_in_time_for_the_face_is_chosen(
    face_delay_s: float, expected_s: float
) -> None:
    assert delay_for(LoudLips().delays_s, face_delay_s) == expected_s
