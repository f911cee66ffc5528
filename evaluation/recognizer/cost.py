"""CPU cost of the recognizer, by stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.services.recognizer.front_end.vad import BLOCK_SAMPLES, VoiceActivityDetector
from kouxing.services.recognizer.search.decoder import Decoder

CHUNK_SAMPLES = 160  # 10 ms, as live audio arrives


def cpu_by_stage(model: AcousticModel, samples: NDArray[np.float32]) -> dict[str, float]:
    """Return CPU seconds per second of audio by stage, with chunks of 10 ms."""
    chunks = [samples[at : at + CHUNK_SAMPLES] for at in range(0, len(samples), CHUNK_SAMPLES)]
    blocks = [
        samples[at : at + BLOCK_SAMPLES]
        for at in range(0, len(samples) - BLOCK_SAMPLES + 1, BLOCK_SAMPLES)
    ]
    front_end, stream = model.create_front_end(), model.create_stream()
    decoder = Decoder(model.topology)
    detector, resampler = VoiceActivityDetector(), Resampler(48_000)
    frames = model.create_front_end().accept_waveform(samples)
    scores = model.create_stream().score(frames)  # compiles before the clock starts
    decoder.advance(scores[:1])
    decoder.reset()

    def run(
        stage: Callable[[NDArray[np.float32]], object], pieces: Iterable[NDArray[np.float32]]
    ) -> float:
        start = time.process_time()
        for piece in pieces:
            stage(piece)
        return (time.process_time() - start) * SAMPLE_RATE_HZ / len(samples)

    at_48_khz = np.array_split(np.repeat(samples, 3), len(chunks))
    return {
        "resampler_from_48_khz": run(resampler.accept_waveform, at_48_khz),
        "voice_activity": run(detector.detect, blocks),
        "front_end": run(front_end.accept_waveform, chunks),
        "acoustic_model": run(stream.score, np.split(frames, len(frames))),
        "decoder": run(decoder.advance, np.split(scores, len(scores))),
    }
