"""A session's audio and its events: gaps, flushes, chunks, silence, and times in whole samples."""

from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

import numpy as np
import pytest
from kouxing_client.messages import Message

from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.live.stream import MAX_JITTER_SAMPLES
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.recognizer.search import frame_search, path_records
from kouxing.shared.phones.events import (
    AudioSkipped,
    EndOfSound,
    LipPositions,
    Phone,
    Progress,
    SpeechChange,
    Waveform,
)
from kouxing.shared.wire.events import event_to_message
from tests.live_streams import LiveStream, recognize_live, recognize_together
from tests.system import HELLO, VOWELS_FILE, samples_of_file

SAMPLES = samples_of_file(VOWELS_FILE)[:22_400]
RATE_HZ = 16_000
FACE: dict[str, Any] = {"lip_predictor": load_lip_predictor(), "face_delay_s": 0.1}
E = TypeVar("E")


@cache
def results_of_vowels(chunk: int | None = None, *, with_lips: bool = True) -> list[StreamOutput]:
    """Return the results of an undisturbed session, which several tests compare with theirs."""
    return recognize_live(load_model(), SAMPLES, chunk, **(FACE if with_lips else {}))


def of_kind(kind: type[E], outputs: Sequence[StreamOutput]) -> list[E]:
    return [output for output in outputs if isinstance(output, kind)]


def messages_of(outputs: Sequence[StreamOutput]) -> list[Message]:
    """Return messages, which can be compared; events with arrays cannot."""
    return [event_to_message(output) for output in outputs if not isinstance(output, Waveform)]


def assert_same(
    kinds: tuple[type, ...], outputs: Sequence[StreamOutput], expected: Sequence[StreamOutput]
) -> None:
    """Compare the events of each kind; events of different kinds may have another order."""
    for kind in kinds:
        assert of_kind(kind, expected)
        assert messages_of(of_kind(kind, outputs)) == messages_of(of_kind(kind, expected))


@pytest.mark.parametrize(("rate_hz", "size"), [(16_000, 97), (44_100, 1021)])
def test_chunk_sizes_do_not_affect_results(rate_hz: int, size: int) -> None:
    expected, outputs = (
        recognize_live(load_model(), SAMPLES, chunk, sample_rate_hz=rate_hz, **FACE)
        for chunk in (None, size)
    )
    assert messages_of(outputs) == messages_of(expected)
    audio = [output.samples for output in of_kind(Waveform, outputs)]
    np.testing.assert_array_equal(np.concatenate(audio), to_16_khz(SAMPLES, rate_hz))


def test_a_gap_ends_the_speech_and_recognition_restarts_after_it() -> None:
    alone = of_kind(Phone, results_of_vowels(with_lips=False))
    stream = LiveStream(load_model(), **FACE)
    gap = len(SAMPLES) + MAX_JITTER_SAMPLES + 1
    stream.stream.accept_waveform(SAMPLES, 0)
    outputs = stream.feed(SAMPLES, gap) + stream.finish()
    assert stream.stream.num_gaps == 1
    phones = of_kind(Phone, outputs)
    after = [phone for phone in phones if phone.index > max(phone.index for phone in alone)]
    assert phones[: len(alone)] == alone
    for earlier, later in zip(alone, after, strict=True):
        assert (earlier.symbol, earlier.final, earlier.duration_s) == (
            later.symbol,
            later.final,
            later.duration_s,
        )
        assert later.onset_s - earlier.onset_s == pytest.approx(gap / RATE_HZ)
    states = [event.active for event in of_kind(SpeechChange, outputs)]
    assert states == [True, False] * (len(states) // 2)
    assert len(of_kind(EndOfSound, outputs)) == 1
    lips = of_kind(LipPositions, outputs)
    middle = len(lips) // 2
    for first, second in zip(lips[:middle], lips[middle:], strict=True):
        assert second.time_s - first.time_s == pytest.approx(gap / RATE_HZ)
        np.testing.assert_array_equal(first.faps, second.faps)


def test_skips_to_newer_audio() -> None:
    stream = LiveStream(load_model(), **FACE)
    outputs = stream.feed(SAMPLES[:8000])
    stream.stream.skip_to(40_000)
    outputs += stream.feed(SAMPLES, 40_000) + stream.finish()
    skips = [number for number, event in enumerate(outputs) if isinstance(event, AudioSkipped)]
    assert [skip.time_s for skip in of_kind(AudioSkipped, outputs)] == [2.5]
    before, after = outputs[: skips[0]], outputs[skips[0] :]
    assert all(phone.final for phone in {p.index: p for p in of_kind(Phone, before)}.values())
    assert min(phone.onset_s for phone in of_kind(Phone, after)) >= 2.5
    assert stream.stream.num_gaps == 0


@pytest.mark.parametrize("cuts", [[9600, 14_400], [320, 10_240], [0, 50_000]])
def test_the_light_model_does_not_change_the_lips(cuts: list[int]) -> None:
    expected = results_of_vowels(320)
    stream = LiveStream(load_model(), **FACE)
    outputs = []
    for number, part in enumerate(np.split(SAMPLES, cuts)):
        stream.stream.set_light_model(number == 1)
        outputs += stream.feed(part, chunk=320)
    outputs += stream.finish()
    assert_same((LipPositions, SpeechChange, Progress), outputs, expected)
    phones = [phone for phone in of_kind(Phone, outputs) if phone.final]
    assert [phone.index for phone in phones] == list(range(len(phones)))
    end_s = 0.0
    for phone in phones:
        if not phone.is_withdrawn:
            assert end_s == 0.0 or phone.onset_s == pytest.approx(end_s, abs=1e-4)
            end_s = phone.end_s


def test_jitter_is_not_a_gap() -> None:
    stream = LiveStream(load_model())
    outputs = stream.feed(SAMPLES[:8000], 0) + stream.feed(
        SAMPLES[8000:], 8000 + MAX_JITTER_SAMPLES
    )
    assert stream.stream.num_gaps == 0
    expected = results_of_vowels(with_lips=False)
    assert messages_of(outputs + stream.finish()) == messages_of(expected)


def test_a_flush_ends_the_speech_and_drops_it() -> None:
    stream = LiveStream(load_model())
    spoken = of_kind(Phone, stream.feed(SAMPLES[:16_000]))
    assert spoken
    stream.stream.flush()
    assert stream.decode() == [SpeechChange(active=False, time_s=1.0)]
    stream.stream.flush()
    assert stream.decode() == []
    rest = stream.feed(SAMPLES) + stream.finish()
    later = of_kind(Phone, rest)
    assert min(phone.index for phone in later) == 1 + max(phone.index for phone in spoken)
    assert [(p.symbol, p.duration_s) for p in later] == [
        (p.symbol, p.duration_s) for p in of_kind(Phone, results_of_vowels(with_lips=False))
    ]
    assert min(phone.onset_s for phone in later) > 1.0
    assert rest[-1] == EndOfSound(time_s=1.0 + len(SAMPLES) / RATE_HZ)


@pytest.mark.parametrize(("rate_hz", "before_s"), [(16_000, 0.5), (44_100, 0.51), (48_000, 0.537)])
def test_lip_positions_are_known_5_ms_before_the_face_frame(rate_hz: int, before_s: float) -> None:
    times_s = np.arange(round((before_s + len(SAMPLES) / RATE_HZ) * rate_hz)) / rate_hz
    samples = np.interp(times_s, before_s + np.arange(len(SAMPLES)) / RATE_HZ, SAMPLES, left=0.0)
    stream = LiveStream(load_model(), sample_rate_hz=rate_hz, **FACE)
    newest_s, is_speaking, lags_s = 0.0, False, []
    for event in stream.feed(samples.astype(np.float32)):
        if isinstance(event, LipPositions):
            newest_s = event.time_s + event.delay_s
        elif isinstance(event, SpeechChange):
            is_speaking = event.active
        elif isinstance(event, Progress) and is_speaking:
            lags_s.append(event.time_s - newest_s)
    assert len(lags_s) > 30
    np.testing.assert_allclose(lags_s, 0.005, atol=1e-9)


def test_other_sessions_do_not_affect_results() -> None:
    recordings = [SAMPLES, SAMPLES[8000:], SAMPLES[:9000]]
    together = recognize_together(load_model(), recordings, **FACE)
    for samples, outputs in zip(recordings, together, strict=True):
        assert messages_of(outputs) == messages_of(recognize_live(load_model(), samples, **FACE))


def test_lips_may_be_early_and_phones_are_the_same() -> None:
    expected = results_of_vowels(320)
    recognizer = Recognizer(load_model())
    stream = recognizer.create_stream(**FACE)
    outputs: list[StreamOutput] = []
    num_early = 0
    for begin in range(0, len(SAMPLES), 320):
        stream.accept_waveform(SAMPLES[begin : begin + 320])
        recognizer.detect_speech([stream])
        if stream.needs_network:
            stream.decode_early()
            early = stream.take_results()
            assert not of_kind(Phone, early)
            num_early += len(of_kind(LipPositions, early))
            outputs += early
        recognizer.decode_streams([stream])
        outputs += stream.take_results()
    stream.input_finished()
    recognizer.decode_streams([stream])
    outputs += stream.take_results()
    assert num_early > 20
    assert_same((Phone, LipPositions, Progress, SpeechChange), outputs, expected)


def test_lips_continue_during_scoring_and_results_are_the_same() -> None:
    outputs: list[list[StreamOutput]] = []
    num_early = 0
    for continues in (False, True):
        recognizer = Recognizer(load_model())
        stream = recognizer.create_stream(**FACE)
        stream.set_hop(4)
        results: list[StreamOutput] = []
        is_scoring = False
        for begin in range(0, len(SAMPLES), 320):
            stream.accept_waveform(SAMPLES[begin : begin + 320])
            recognizer.detect_speech([stream])
            if is_scoring:  # the other thread finishes after the next chunk
                stream.decode_early()
                early = stream.take_results()
                num_early += len(of_kind(LipPositions, early))
                results += early
                recognizer.decode_speech([stream])
                stream.end_background_scoring()
                recognizer.detect_speech([stream])
            elif stream.needs_network:
                stream.decode_early()
                results += stream.take_results()
                if continues:
                    stream.begin_background_scoring()
            is_scoring = stream.can_accept_while_scoring(stream.next_media_time)
            if not is_scoring:
                recognizer.decode_speech([stream])
                results += stream.take_results()
        outputs.append(results)
    assert num_early > 5
    assert_same((Phone, LipPositions, Progress, SpeechChange), outputs[1], outputs[0])


def test_no_audio_follows_during_scoring_after_queued_events_or_a_gap() -> None:
    recognizer = Recognizer(load_model())
    stream = recognizer.create_stream(**FACE)
    stream.set_hop(4)
    recognizer.decode_streams([stream])
    begin = 0
    while not stream.needs_network:
        stream.accept_waveform(SAMPLES[begin : begin + 320])
        recognizer.detect_speech([stream])
        begin += 320
    stream.begin_background_scoring()
    assert not stream.can_accept_while_scoring(begin)  # the lips of this audio are not sent yet
    stream.end_background_scoring()
    stream.decode_early()
    stream.begin_background_scoring()
    assert stream.can_accept_while_scoring(begin)
    assert not stream.can_accept_while_scoring(begin + MAX_JITTER_SAMPLES + 1)
    stream.end_background_scoring()
    assert not stream.can_accept_while_scoring(begin)


def test_a_longer_hop_changes_only_the_phones() -> None:
    expected = results_of_vowels(320)
    stream = LiveStream(load_model(), **FACE)
    stream.stream.set_hop(4)
    outputs = [*stream.feed(SAMPLES, chunk=320), *stream.finish()]
    assert_same((LipPositions, Progress, SpeechChange), outputs, expected)
    symbols, expected_symbols = (
        [phone.symbol for phone in of_kind(Phone, results) if phone.final and phone.is_spoken]
        for results in (outputs, expected)
    )
    assert symbols == expected_symbols


def hello_phones() -> list[Phone]:
    return of_kind(Phone, recognize_live(load_model(), HELLO, 320))


@pytest.mark.slow
def test_silence_and_noise_have_no_phones() -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, 32_000).astype(np.float32)
    outputs = recognize_live(load_model(), noise, 320)
    assert not any(isinstance(output, Phone | SpeechChange) for output in outputs)
    assert recognize_recording(load_model(), noise) == []


@pytest.mark.slow
def test_warm_up_compiles_everything_and_changes_no_result() -> None:
    expected = hello_phones()
    Recognizer(load_model()).warm_up()
    assert frame_search.advance_frames.signatures
    assert path_records.count_record_paths.signatures
    assert path_records.compact_records.signatures
    assert hello_phones() == expected
