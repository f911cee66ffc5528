"""A session's audio and its events: gaps, flushes, chunks, and times in whole samples."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lip_frames import delay_for
from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.services.recognizer.stream import MAX_JITTER, SILENT_DB
from kouxing.shared.phones.events import (
    EndOfSound,
    LipPositions,
    Phone,
    Progress,
    SoundEvent,
    SpeechChange,
    Waveform,
)
from kouxing.shared.wire.events import message_of
from kouxing.shared.wire.message import Message
from tests.e2e.following import samples_of_file
from tests.live_streams import LiveStream, recognize_live, recognize_together
from tests.made_up_lips import JAW, LoudLips
from tests.system import VOWELS_FILE

pytestmark = pytest.mark.unit

MODEL = load_model()
SAMPLES = samples_of_file(VOWELS_FILE)
RATE_HZ = 16_000


def events_of(outputs: Sequence[StreamOutput]) -> list[SoundEvent]:
    return [output for output in outputs if not isinstance(output, Waveform)]


def phones_of(outputs: Sequence[StreamOutput]) -> list[Phone]:
    return [output for output in outputs if isinstance(output, Phone)]


def lips_of(outputs: Sequence[StreamOutput]) -> list[LipPositions]:
    return [output for output in outputs if isinstance(output, LipPositions)]


def messages_of(outputs: Sequence[StreamOutput]) -> list[Message]:
    """Return messages, which can be compared; events with arrays cannot."""
    return [message_of(event) for event in events_of(outputs)]


def test_times_are_whole_samples_and_progress_comes_every_20_ms() -> None:
    outputs = recognize_live(MODEL, SAMPLES[:-7])
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


@pytest.mark.parametrize("lips", [None, LoudLips()])
@pytest.mark.parametrize(("rate_hz", "size"), [(16_000, 97), (44_100, 1021), (48_000, 1021)])
def test_chunk_sizes_do_not_affect_results(rate_hz: int, size: int, lips: LoudLips | None) -> None:
    expected, outputs = (
        recognize_live(MODEL, SAMPLES, chunk, sample_rate_hz=rate_hz, lips=lips, face_delay_s=0.1)
        for chunk in (None, size)
    )
    assert messages_of(outputs) == messages_of(expected)
    audio = [output.samples for output in outputs if isinstance(output, Waveform)]
    np.testing.assert_array_equal(np.concatenate(audio), to_16_khz(SAMPLES, rate_hz))


def test_a_gap_ends_the_speech_and_recognition_restarts_after_it() -> None:
    alone = phones_of(recognize_live(MODEL, SAMPLES))
    stream = LiveStream(MODEL, lips=LoudLips(), face_delay_s=0.1)
    gap = len(SAMPLES) + MAX_JITTER + 1
    stream.stream.accept_waveform(SAMPLES, 0)
    outputs = stream.feed(SAMPLES, gap) + stream.finish()
    assert stream.stream.num_gaps == 1
    num_before = 1 + max(phone.index for phone in alone)
    first, second = (
        [phone for phone in phones_of(outputs) if (phone.index >= num_before) == is_after]
        for is_after in (False, True)
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
    before, after = (
        [lip for lip in lips_of(outputs) if (lip.time_s >= gap / RATE_HZ) == is_after]
        for is_after in (False, True)
    )
    for one, other in zip(before, after, strict=True):
        assert other.time_s - one.time_s == pytest.approx(gap / RATE_HZ)
        np.testing.assert_array_equal(one.faps, other.faps)


def test_jitter_is_not_a_gap() -> None:
    stream = LiveStream(MODEL)
    outputs = stream.feed(SAMPLES[:8000], 0) + stream.feed(SAMPLES[8000:], 8000 + MAX_JITTER)
    assert stream.stream.num_gaps == 0
    assert events_of(outputs + stream.finish()) == events_of(recognize_live(MODEL, SAMPLES))


def test_a_flush_ends_the_speech_and_drops_it() -> None:
    stream = LiveStream(MODEL)
    spoken = phones_of(stream.feed(SAMPLES[:16_000]))
    assert spoken
    stream.stream.flush()
    assert stream.decode() == [SpeechChange(active=False, time_s=1.0)]
    stream.stream.flush()
    assert stream.decode() == []
    rest = stream.feed(SAMPLES) + stream.finish()
    later = phones_of(rest)
    assert min(phone.index for phone in later) == 1 + max(phone.index for phone in spoken)
    assert [(p.symbol, p.duration_s) for p in later] == [
        (p.symbol, p.duration_s) for p in phones_of(recognize_live(MODEL, SAMPLES))
    ]
    assert min(phone.onset_s for phone in later) > 1.0
    assert rest[-1] == EndOfSound(time_s=1.0 + len(SAMPLES) / RATE_HZ)


def test_audio_may_start_within_speech() -> None:
    within_er = SAMPLES[8_000:12_000]  # speech in the first block, before the first position
    outputs = LiveStream(MODEL).feed(within_er)
    changes = [output for output in outputs if isinstance(output, SpeechChange)]
    assert [change.active for change in changes] == [True]
    assert changes[0].time_s < 0.04


def test_lip_frames_come_in_time_every_20_ms_of_speech() -> None:
    stream = LiveStream(MODEL, lips=LoudLips(), face_delay_s=0.1)
    silence = np.zeros(RATE_HZ, np.float32)
    samples = np.concatenate([silence, SAMPLES, silence])
    speech_s, frames, is_live = [], [], []
    for begin in range(0, len(samples), 320):
        outputs = stream.feed(samples[begin : begin + 320])
        known_s = (begin + 320) / RATE_HZ
        speech_s += [event.time_s for event in outputs if isinstance(event, SpeechChange)]
        new = lips_of(outputs)
        is_live.append(len(new) == 1)
        # the newest frame comes with its audio, not 20 ms later
        assert all(lip.time_s + lip.delay_s <= known_s for lip in new)
        assert not new or new[-1].time_s + new[-1].delay_s > known_s - 0.02
        frames += new
    assert sum(is_live) > 50
    times = np.array([frame.time_s for frame in frames])
    np.testing.assert_allclose(times * RATE_HZ, np.rint(times * RATE_HZ), atol=1e-6)
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    assert times[0] > speech_s[0] - 0.1 - 1e-6
    assert speech_s[-1] - 0.15 < times[-1] < speech_s[-1]
    assert all(frame.delay_s == 0.085 for frame in frames)
    jaw = np.array([frame.faps[JAW] for frame in frames])
    assert jaw.max() > jaw.min() + 20.0


@pytest.mark.parametrize("rate_hz", [16_000, 44_100, 48_000])
@pytest.mark.parametrize("before_s", [0.5, 0.51, 0.537])
def test_lip_frames_are_known_5_ms_before_the_face_frame(rate_hz: int, before_s: float) -> None:
    silence = np.zeros(round(before_s * rate_hz), np.float32)
    samples = np.concatenate([silence, interpolate(SAMPLES, rate_hz)])
    stream = LiveStream(MODEL, sample_rate_hz=rate_hz, lips=LoudLips(), face_delay_s=0.1)
    newest_s, is_speaking, lags_s = 0.0, False, []
    for event in stream.feed(samples):
        if isinstance(event, LipPositions):
            newest_s = event.time_s + event.delay_s
        elif isinstance(event, SpeechChange):
            is_speaking = event.active
        elif isinstance(event, Progress) and is_speaking:
            lags_s.append(event.time_s - newest_s)
    assert len(lags_s) > 50
    np.testing.assert_allclose(lags_s, 0.005, atol=1e-9)


def interpolate(samples: NDArray[np.float32], rate_hz: int) -> NDArray[np.float32]:
    """Resample 16 kHz roughly, for voice activity detection."""
    times_s = np.arange(len(samples) * rate_hz // RATE_HZ) / rate_hz
    return np.interp(times_s, np.arange(len(samples)) / RATE_HZ, samples).astype(np.float32)


def test_other_sessions_do_not_affect_results() -> None:
    recordings = [SAMPLES, SAMPLES[8000:], SAMPLES[:9000]]
    options: dict[str, Any] = {"lips": LoudLips(), "face_delay_s": 0.1}
    together = recognize_together(MODEL, recordings, **options)
    for samples, outputs in zip(recordings, together, strict=True):
        assert messages_of(outputs) == messages_of(recognize_live(MODEL, samples, **options))


@pytest.mark.parametrize(
    ("face_delay_s", "expected_s"),
    [(0.0, -0.005), (0.025, -0.005), (0.04, 0.025), (0.16, 0.145)],
)
def test_chooses_the_longest_delay_in_time_for_the_face(
    face_delay_s: float, expected_s: float
) -> None:
    assert delay_for(LoudLips().delays_s, face_delay_s) == expected_s
