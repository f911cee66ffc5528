"""Streams audio through a running system and collects what comes out."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared.audio_file import read_audio
from shared.bus import Received
from shared.client import Client, Session
from shared.messages import (
    EndOfFaps,
    FapFrame,
    Message,
    PhoneHeard,
    Sound,
    Speech,
)


@dataclass
class Heard:
    frames: list[FapFrame] = field(default_factory=list)
    phones: list[PhoneHeard] = field(default_factory=list)
    speech: list[Speech] = field(default_factory=list)
    sounds: list[Sound] = field(default_factory=list)
    ended: bool = False

    def take(self, message: object) -> None:
        if isinstance(message, FapFrame):
            self.frames.append(message)
        elif isinstance(message, PhoneHeard):
            self.phones.append(message)
        elif isinstance(message, Speech):
            self.speech.append(message)
        elif isinstance(message, Sound):
            self.sounds.append(message)
        elif isinstance(message, EndOfFaps):
            self.ended = True

    @property
    def faps(self) -> NDArray[np.float32]:
        """FAPs of all frames, shape (frames, 68)."""
        return np.array([np.frombuffer(f.values, "<f4") for f in self.frames])

    @property
    def units(self) -> list[str]:
        """The final units, in order."""
        last = {phone.index: phone.unit for phone in self.phones}
        return [last[index] for index in sorted(last)]


def samples_of_file(path: Path) -> NDArray[np.float32]:
    samples, rate_hz = read_audio(path)
    assert rate_hz == 16000
    return samples[:, 0]


def stream(
    control: str,
    samples: NDArray[np.float32],
    *,
    chunk: int = 320,
    session: str = "",
    sample_rate_hz: int = 16000,
    paced: bool = False,
    record: bool = False,
) -> Heard:
    """Stream float samples, paced or as fast as possible, and wait for the last frame."""
    with Client(control) as client:
        opened = client.open_session(
            session=session,
            encoding="f32le",
            sample_rate_hz=sample_rate_hz,
            num_channels=1,
            paced=paced,
            record=record,
        )
        try:
            return stream_into(opened, samples, chunk=chunk, rate_hz=sample_rate_hz, paced=paced)
        finally:
            opened.close()


def stream_into(
    opened: Session,
    samples: NDArray[np.float32],
    *,
    chunk: int,
    rate_hz: int = 16000,
    paced: bool = False,
) -> Heard:
    kinds: tuple[type[Message], ...] = (FapFrame, EndOfFaps, PhoneHeard, Speech, Sound)
    output = opened.subscribe(*kinds)
    heard = Heard()
    begin_s = time.monotonic()
    for begin in range(0, len(samples), chunk):
        while not opened.send(samples[begin : begin + chunk]):
            output.wait(0.02)
            collect(output.receive(), heard)
        if paced:
            due_s = begin_s + (begin + chunk) / rate_hz
            while time.monotonic() < due_s:
                output.wait(max(0.001, due_s - time.monotonic()))
                collect(output.receive(), heard)
    while not opened.finish():
        output.wait(0.02)
        collect(output.receive(), heard)
    end_s = time.monotonic() + 60
    while not heard.ended:
        assert time.monotonic() < end_s, "the last frame did not come"
        output.wait(0.2)
        collect(output.receive(), heard)
    collect(output.receive(), heard)
    return heard


def collect(received: Iterable[Received], heard: Heard) -> None:
    for each in received:
        heard.take(each.message)
