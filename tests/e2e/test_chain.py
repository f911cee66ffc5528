"""A WAV file through real processes over real sockets: phones, FAP frames, video."""

from __future__ import annotations

import itertools
import signal
import time

import numpy as np
import pytest
from kouxing_client import Client, FapFrame

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.phones.inventory import load_inventory
from tests.e2e.following import Stream, samples_of_file, stream
from tests.system import DEMO, System

DELAY = round(SynthesizerConfig().delay_ms * 16)  # samples
OPEN_JAW = 2  # index of FAP 3
SENTENCE = samples_of_file(DEMO / "hello-female.wav")


def opening(frame: FapFrame) -> float:
    """Return how far the mouth is from rest, in FAP units."""
    return float(np.abs(np.frombuffer(frame.values, "<f4")[2:13]).max())


@pytest.fixture(scope="module")
def sent(system: System) -> Stream:
    return stream(system.control, SENTENCE)


def test_every_frame_arrives_in_order_until_the_end(sent: Stream) -> None:
    assert [frame.sequence for frame in sent.frames] == [*range(1, len(sent.frames) + 1)]
    assert sent.times == [*range(0, 320 * len(sent.frames), 320)]
    assert sent.times[-1] >= len(SENTENCE)


def test_phones_become_final_and_speech_starts_and_ends(sent: Stream) -> None:
    assert len(sent.symbols) > 20
    assert {*sent.symbols} <= {*load_inventory().phones}
    assert all({phone.index: phone.final for phone in sent.phones}.values())
    states = [speech.active for speech in sent.speech]
    assert (states[0], states[-1]) == (True, False)
    assert all(before != after for before, after in itertools.pairwise(states))


def test_the_mouth_moves_during_speech_and_rests_before_and_after(sent: Stream) -> None:
    faps = sent.faps
    begin = sent.speech[0].media_time // 320
    mouth = [*range(2, 13), *range(50, 60)]
    assert np.abs(faps[: max(1, begin - 5), mouth]).max() < 1
    assert np.abs(faps[-1, mouth]).max() < 1
    assert faps[:, 18].max() > 500, "the eyes blink"
    assert faps[:, OPEN_JAW].max() > 200
    assert np.isfinite(faps).all()


def test_the_sound_is_the_audio_that_was_sent(sent: Stream) -> None:
    sound = np.concatenate([np.frombuffer(sound.pcm, "<i2") for sound in sent.sounds])
    np.testing.assert_allclose(sound / 32768, SENTENCE, atol=1e-4)


def test_real_time_gives_the_frames_of_as_fast_as_possible(system: System, sent: Stream) -> None:
    samples = SENTENCE[:32000]
    fast = stream(system.control, samples)
    end_s = time.monotonic() + 90
    numbers = [frame.sequence for frame in fast.frames]
    while True:
        live = stream(system.control, samples, paced=True)
        if [frame.sequence for frame in live.frames] == numbers:
            break  # a stall of the machine for 0.2 s adds frames of rest, also before the first
        assert time.monotonic() < end_s, "this machine stalls too often for real time"
    np.testing.assert_array_equal(live.faps, fast.faps)


def num_repeated(sent: Stream) -> int:
    """Return how many frames repeat the media time of the one before, since the first sound."""
    times = [time for time in sent.times if time > 0]
    return sum(after == before for before, after in itertools.pairwise(times))


def test_the_face_waits_for_a_slow_recognizer_and_rests_for_a_silent_client(system: System) -> None:
    with Client(system.control) as client, client.open_session(encoding="f32le") as session:
        sent = Stream(session)
        sent.send(SENTENCE[:16000], paced=True)
        recognizer = system.process("recognizer")
        recognizer.send_signal(signal.SIGSTOP)
        try:
            sent.send(SENTENCE[16000:40000], paced=True)
        finally:
            recognizer.send_signal(signal.SIGCONT)
        sent.send(SENTENCE[40000:56000], paced=True)
        sent.collect_until(lambda: sent.times[-1] >= 52000 or num_repeated(sent))
        assert num_repeated(sent) == 0, "the client was not silent"
        sent.collect_until(lambda: num_repeated(sent) >= 10)
        assert opening(sent.frames[-1]) < 1
        sent.send(SENTENCE[56000:64000])
        sent.collect_until(lambda: sent.times[-1] > 60000)
        assert session.take_errors() == []


def test_a_flush_returns_to_rest_within_150_ms(system: System) -> None:
    with (
        Client(system.control) as client,
        client.open_session(encoding="f32le", paced=False) as session,
    ):
        sent = Stream(session)
        sent.send(SENTENCE[:24000], chunk=8000)
        sent.collect_until(lambda: sent.times[-1:] >= [24000 - DELAY])
        assert opening(sent.frames[-1]) > 50, "the mouth is open in mid-sentence"
        num_before = len(sent.frames)
        session.flush()
        client.open_session().close()  # every service has processed control's messages
        session.push(np.zeros(8000, np.float32))
        sent.collect_until(lambda: sent.times[-1] >= 32000 - 3200)
    after = sent.frames[num_before:]
    assert max(map(opening, after[8:])) < 1, "150 ms are 7.5 frames"
