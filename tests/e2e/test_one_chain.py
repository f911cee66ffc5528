"""The services, offline rendering and evaluation make the same frames, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.evaluation.lips.schemes import DEFAULT_DELAY_S, live_scheme, recognize_clip
from kouxing.services.live_chain import LiveChain
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.clock import to_samples
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipPositions, Phone
from kouxing.shared.wire import speech
from kouxing.shared.wire.events import message_of
from tests.e2e.following import Stream, samples_of_file, stream
from tests.lips import LIPS, clip_of
from tests.system import DEMO, VOWELS_FILE, System

MOUTH = np.array(MOUTH_FAPS) - 1


def at_rate(samples: NDArray[np.float32], rate_hz: int) -> NDArray[np.float32]:
    positions = np.arange(len(samples) * rate_hz // 16000) * (16000 / rate_hz)
    resampled: NDArray[np.float32] = np.interp(positions, np.arange(len(samples)), samples).astype(
        np.float32
    )
    return resampled


@pytest.mark.parametrize(
    ("name", "rate_hz", "chunk"),
    [("lake-male", 16000, 97), ("bilabials-female", 44100, 1021), ("hello-male", 48000, 128)],
)
def test_services_send_the_frames_of_the_chain(
    system: System, name: str, rate_hz: int, chunk: int
) -> None:
    samples = at_rate(samples_of_file(DEMO / f"{name}.wav")[:48000], rate_hz)
    samples = samples[: len(samples) // 2 * 2 - 1]  # the sound ends within a slice of 20 ms
    sent = stream(system.control, samples, chunk=chunk, sample_rate_hz=rate_hz)
    chain = LiveChain(load_live_model(), load_lip_model(), sample_rate_hz=rate_hz)
    frames = chain.accept_waveform(samples) + chain.input_finished()

    assert sent.times == [to_samples(time_s) for time_s, _ in frames]
    np.testing.assert_array_equal(sent.faps, np.array([faps for _, faps in frames]))
    assert sent.faps[:, MOUTH].any()
    assert lips_of(sent) == [
        message_of(event) for event in chain.events if isinstance(event, LipPositions)
    ]
    assert sent.lips
    recognised = [event for event in chain.events if isinstance(event, Phone)]
    assert [
        (phone.index, phone.symbol, phone.media_time, phone.duration, phone.confidence, phone.final)
        for phone in sent.phones
    ] == [
        (
            phone.index,
            phone.symbol,
            to_samples(phone.onset_s),
            to_samples(phone.duration_s),
            phone.confidence,
            phone.final,
        )
        for phone in recognised
    ]


def lips_of(sent: Stream) -> list[speech.LipPositions]:
    """Lip frames without session, epoch and sequence."""
    return [
        speech.LipPositions(
            media_time=lips.media_time,
            values=lips.values.tobytes(),
            delay=lips.delay,
            closure=lips.closure,
            lip_to_teeth=lips.lip_to_teeth,
        )
        for lips in sent.lips
    ]


def test_evaluation_scores_the_mouth_of_the_chain() -> None:
    samples = samples_of_file(VOWELS_FILE)
    chain = LiveChain(load_live_model(), LIPS, synthesizer=SynthesizerConfig(expressiveness=1.0))
    frames = chain.accept_waveform(samples) + chain.input_finished()
    clip = replace(clip_of(np.zeros(1), np.zeros((1, len(MOUTH_FAPS)))), samples=samples)
    scheme = live_scheme("lips", LIPS, DEFAULT_DELAY_S)
    scored = scheme.frames(recognize_clip(load_live_model(), clip, None))
    assert scored is not None
    np.testing.assert_array_equal(scored[:, MOUTH], np.array([faps[MOUTH] for _, faps in frames]))
    assert scored[:, MOUTH].any()
