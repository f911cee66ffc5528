"""Latency and CPU cost of the services, with real processes and real sockets.

The services run as under ``kouxing run``, on free ports. A sentence is streamed in real time in 20
ms chunks. Two latencies are measured for each FAP frame:

- *chunk to frame*: from sending the chunk that completes the synthesizer's input to receiving the
  frame. This is the time of processes and sockets;
- *sound to frame*: from sending the last sample of the frame's own chunk. This adds the delay of
  the synthesizer. A page that delays the sound by this time is in sync.

CPU time is measured by the processes, per second of audio.
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kouxing_client import Client, Session
from rich.console import Console

from kouxing.evaluation.percentiles import percentiles
from kouxing.evaluation.system.live import CHUNK_S, speak
from kouxing.evaluation.system.systems import run_all_services
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ, to_seconds
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.errors import UserError

NUM_REPEATS = 3  # number of times that the file is streamed


@dataclass(frozen=True, slots=True)
class Latency:
    """Figures of one run."""

    chunk_to_frame_ms: dict[str, float]
    sound_to_frame_ms: dict[str, float]
    delay_ms: float
    num_frames: int
    cpu_s_per_audio_s: dict[str, float]


def measure(path: Path, console: Console, language: str | None = None) -> Latency:
    """Start the services, stream the file and return the figures; UserError if that fails.

    ``language`` is the language of the speech. If None, it is the recognizer's.
    """
    sound = to_16_khz(*read_audio(path))
    with run_all_services(console) as system, connect_client(system.control) as client:
        before = _cpu_s(client)
        delays = []
        for _ in range(NUM_REPEATS):
            with client.open_session(encoding="f32le", language=language) as session:
                delays.append(stream(session, sound)[1:])
        time.sleep(1.0)  # for the last heartbeats
        after = _cpu_s(client)
    audio_s = NUM_REPEATS * len(sound) / MEDIA_RATE_HZ
    to_frame_ms, from_sound_ms = (np.concatenate(part) * 1e3 for part in zip(*delays, strict=True))
    if not len(to_frame_ms):
        raise UserError("no frame arrived in time; close other programs and try again")
    return Latency(
        chunk_to_frame_ms=percentiles(to_frame_ms),
        sound_to_frame_ms=percentiles(from_sound_ms),
        delay_ms=session.info["facts"]["delay_ms"],
        num_frames=len(to_frame_ms),
        cpu_s_per_audio_s={name: (after[name] - before[name]) / audio_s for name in after},
    )


def stream(session: Session, sound: Floats) -> tuple[Doubles, Doubles, Doubles]:
    """Stream in real time; return media time and both latencies of every frame, seconds.

    The session takes 32-bit floats. Frames after the last sample are omitted. Raises ``UserError``
    if the session does not complete.
    """
    delay_s = session.info["facts"]["delay_ms"] / 1e3
    (received,) = speak([session], sound)
    if received.error or not received.ended:
        reason = received.error or "the last frame did not arrive"
        raise UserError(f"{reason}; close other programs and try again")
    times, to_frame, from_sound = [], [], []
    for arrival_s, frame in received.frames:
        media_s = to_seconds(frame.media_time)
        last_needed = math.ceil((media_s + delay_s) / CHUNK_S - 1e-6) - 1
        last_shown = max(0, round(media_s / CHUNK_S) - 1)
        if arrival_s < received.live_until_s and last_needed < len(received.sent_s):
            times.append(media_s)
            to_frame.append(arrival_s - received.sent_s[max(0, last_needed)])
            from_sound.append(arrival_s - received.sent_s[last_shown])
    return np.array(times), np.array(to_frame), np.array(from_sound)


def _cpu_s(client: Client) -> dict[str, float]:
    return {state.service: state.metrics.get("cpu_s", 0.0) for state in client.status().services}
