"""CPU cost of one recognizer that serves several sessions, without its messages."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.system.live import CHUNK
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lip_predictor import LipPredictor, lip_predictor_for
from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.shared.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ

MODELS = ("neural", "blocks")
NUM_SESSIONS = (1, 16)


def measure(path: Path) -> dict[str, float]:
    """Return CPU seconds per second of sound and session, by model and sessions."""
    samples = to_16_khz(*read_audio(path))
    costs = {}
    for name in MODELS:
        model = load_live_model(name)
        recognizer = Recognizer(model, RecognizerConfig(acoustic=name).output_rule)
        recognizer.warm_up()
        for number in NUM_SESSIONS:
            for lips, note in ((None, ""), (lip_predictor_for(model), " with lips")):
                costs[f"{name}, {number}{note}"] = _cpu_s(recognizer, lips, samples, number)
    return costs


def show(costs: dict[str, float], console: Console) -> None:
    """Print the costs as a table."""
    table = Table("model, sessions of a recognizer", "CPU s per s of audio, each")
    for name, value in costs.items():
        table.add_row(name, f"{value:.3f}")
    console.print(table)


def _cpu_s(
    recognizer: Recognizer,
    lips: LipPredictor | None,
    samples: NDArray[np.float32],
    num_sessions: int,
) -> float:
    """Run every session once through the recording, each from another starting point."""
    streams = [recognizer.create_stream(lips=lips) for _ in range(num_sessions)]
    starts = np.arange(num_sessions) * len(samples) // num_sessions
    sounds = [np.roll(samples, -start) for start in starts]
    start_s = time.process_time()
    for at in range(0, len(samples), CHUNK):
        for stream, sound in zip(streams, sounds, strict=True):
            stream.accept_waveform(sound[at : at + CHUNK])
        recognizer.decode_streams(streams)
        for stream in streams:
            recognizer.get_result(stream)
    cpu_s = time.process_time() - start_s
    return cpu_s * MEDIA_RATE_HZ / len(samples) / num_sessions
