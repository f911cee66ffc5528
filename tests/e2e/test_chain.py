"""A wav through real processes over real sockets: phones, FAP frames, video."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable

import av
import numpy as np
import pytest
from kouxing_client import Client, FapFrame, Results

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.phones.inventory import load_inventory
from tests.e2e.following import Collected, samples_of_file, stream, stream_into
from tests.system import DEMO, VOWELS_FILE, System

pytestmark = pytest.mark.e2e
DELAY = round(SynthesizerConfig().delay_ms * 16)  # samples
OPEN_JAW, RAISE_B_MIDLIP = 2, 4  # indices of FAP 3 and 5


@pytest.fixture(scope="module")
def collected(system: System) -> Collected:
    return stream(system.control, samples_of_file(DEMO / "hello-female.wav"))


def test_every_frame_arrives_in_order_and_on_time(collected: Collected) -> None:
    times = np.array([frame.media_time for frame in collected.frames])
    assert [f.sequence for f in collected.frames] == list(range(1, len(collected.frames) + 1))
    np.testing.assert_array_equal(np.diff(times), 320)
    assert times[0] == 0
    assert times[-1] >= len(samples_of_file(DEMO / "hello-female.wav"))


def test_phones_are_those_of_the_language_and_final_in_the_end(collected: Collected) -> None:
    assert len(collected.symbols) > 20
    assert set(collected.symbols) <= set(load_inventory().phones)
    finals = {phone.index: phone.final for phone in collected.phones}
    assert all(finals.values())


def test_speech_begins_and_ends(collected: Collected) -> None:
    states = [speech.active for speech in collected.speech]
    assert states[0]
    assert not states[-1]
    assert all(a != b for a, b in itertools.pairwise(states))


def test_the_mouth_moves_while_there_is_speech_and_rests_before_and_after(
    collected: Collected,
) -> None:
    faps = collected.faps
    begin = collected.speech[0].media_time // 320
    mouth = list(range(2, 13)) + list(range(50, 60))
    assert np.abs(faps[: max(1, begin - 5), mouth]).max() < 1
    assert np.abs(faps[-1, mouth]).max() < 1
    assert faps[:, 18].max() > 500, "the eyes blink"
    assert faps[:, OPEN_JAW].max() > 200
    assert np.isfinite(faps).all()


def test_the_sound_is_the_audio_that_was_sent(collected: Collected) -> None:
    sound = np.concatenate([np.frombuffer(sound.pcm, "<i2") for sound in collected.sounds])
    sent = samples_of_file(DEMO / "hello-female.wav")
    np.testing.assert_allclose(sound / 32768, sent, atol=1e-4)


def test_real_time_gives_the_frames_of_as_fast_as_possible(system: System) -> None:
    samples = samples_of_file(VOWELS_FILE)
    fast = stream(system.control, samples)
    end_s = time.monotonic() + 90
    while True:
        live = stream(system.control, samples, paced=True)
        if [frame.sequence for frame in live.frames] == [frame.sequence for frame in fast.frames]:
            break  # a machine that stalls for 0.2 s gets frames of rest before, or in between
        assert time.monotonic() < end_s, "this machine stalls too often for real time"
    np.testing.assert_array_equal(live.faps, fast.faps)


def test_int16_stereo_gives_the_phones_of_float_mono(system: System, collected: Collected) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")
    stereo = np.stack([samples, samples], axis=1) * 32768
    stereo = np.rint(stereo).clip(-32768, 32767).astype(np.int16)
    with Client(system.control) as client:
        session = client.open_session(encoding="s16le", num_channels=2, paced=False)
        result = stream_into(session, stereo, chunk=320)
        session.close()
    assert result.symbols == collected.symbols


def test_a_stalled_stream_leads_to_rest_and_then_goes_on(system: System) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")
    with Client(system.control) as client:
        session = client.open_session(encoding="f32le")
        output = session.results(FapFrame, keep_all=True)
        session.push(samples[:8000])
        session.push(samples[8000:16000])
        spoken = _frames_until(output, lambda frame: _opening(frame) > 50)
        still = _frames_until(output, lambda frame: _opening(frame) < 1)
        assert still[-1].media_time == still[-5].media_time, (
            "media time stands still with the sound"
        )
        assert spoken[0].media_time < still[-1].media_time <= 16000
        session.push(samples[16000:24000])
        _frames_until(output, lambda frame: frame.media_time > 20000)
        session.close()


def test_a_flush_returns_to_rest_within_150_ms(system: System) -> None:
    samples = samples_of_file(DEMO / "hello-female.wav")
    with Client(system.control) as client:
        session = client.open_session(encoding="f32le", paced=False)
        output = session.results(FapFrame, keep_all=True)
        for begin in range(0, 24000, 8000):
            session.push(samples[begin : begin + 8000])
        before = _frames_until(output, lambda frame: frame.media_time >= 24000 - DELAY)
        assert _opening(before[-1]) > 50, "the mouth is open in mid-sentence"
        session.flush()
        client.open_session().close()  # every service has what control told it before
        session.push(np.zeros(8000, np.float32))
        after = _frames_until(output, lambda frame: frame.media_time >= 32000 - 3200)
        session.close()
    assert max(_opening(frame) for frame in after[8:]) < 1, "150 ms are 7.5 frames"


def _opening(frame: FapFrame) -> float:
    """Return how far the mouth is from rest, in FAP units."""
    return float(np.abs(np.frombuffer(frame.values, "<f4")[2:13]).max())


def _frames_until(output: Results[FapFrame], last: Callable[[FapFrame], bool]) -> list[FapFrame]:
    """Return the frames up to the first that ``last`` holds for."""
    frames: list[FapFrame] = []
    end_s = time.monotonic() + 60
    while time.monotonic() < end_s:
        for frame in output.available(0.1):
            frames.append(frame)
            if last(frame):
                return frames
    raise AssertionError("the frame did not come")


def test_the_driver_records_picture_and_sound_in_sync(system: System) -> None:
    samples = samples_of_file(VOWELS_FILE)
    stream(system.control, samples, session="film", record=True)
    path = system.folder / "film.mp4"
    end_s = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < end_s, system.log("driver")
        time.sleep(0.1)
    with av.open(str(path)) as film:
        images = sum(1 for _ in film.decode(video=0))
    with av.open(str(path)) as film:
        sound_s = sum(f.samples for f in film.decode(audio=0)) / film.streams.audio[0].rate
    expected_s = len(samples) / 16000
    assert images / 25 == pytest.approx(expected_s, abs=0.6)
    assert images / 25 >= expected_s - 0.05
    assert sound_s == pytest.approx(expected_s, abs=0.15)
