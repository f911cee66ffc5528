"""Streams audio through a running system and collects what comes out."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.audio_file import read_audio
from kouxing.shared.bus import Received
from kouxing.shared.client import Client, Session, Subscription
from kouxing.shared.wire.audio import Sound
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.speech import Lips, Phone, Speech

KINDS: tuple[type[Message], ...] = (FapFrame, EndOfFaps, Phone, Lips, Speech, Sound)


@dataclass
class Collected:
    frames: list[FapFrame] = field(default_factory=list)
    phones: list[Phone] = field(default_factory=list)
    lips: list[Lips] = field(default_factory=list)
    speech: list[Speech] = field(default_factory=list)
    sounds: list[Sound] = field(default_factory=list)
    ended: bool = False

    def add(self, received: Iterable[Received]) -> None:
        for each in received:
            match each.message:
                case FapFrame() as frame:
                    self.frames.append(frame)
                case Phone() as phone:
                    self.phones.append(phone)
                case Lips() as lips:
                    self.lips.append(lips)
                case Speech() as speech:
                    self.speech.append(speech)
                case Sound() as sound:
                    self.sounds.append(sound)
                case EndOfFaps():
                    self.ended = True

    @property
    def faps(self) -> NDArray[np.float32]:
        """FAPs of all frames, shape (frames, 68)."""
        return np.array([np.frombuffer(f.values, "<f4") for f in self.frames])

    @property
    def symbols(self) -> list[str]:
        """The final phones, in order."""
        last = {phone.index: phone.symbol for phone in self.phones}
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
) -> Collected:
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
    session: Session,
    samples: NDArray[np.float32],
    *,
    chunk: int,
    rate_hz: int = 16000,
    paced: bool = False,
) -> Collected:
    """Stream samples into an open session and wait for the last frame."""
    output = session.subscribe(*KINDS)
    collected = Collected()
    send(session, samples, output, collected, chunk=chunk, rate_hz=rate_hz, paced=paced)
    finish(session, output, collected)
    return collected


def send(
    session: Session,
    samples: NDArray[np.float32],
    output: Subscription,
    collected: Collected,
    *,
    chunk: int = 320,
    rate_hz: int = 16000,
    paced: bool = False,
) -> None:
    """Send samples, collecting what comes out meanwhile."""
    begin_s = time.monotonic()
    for begin in range(0, len(samples), chunk):
        while not session.send(samples[begin : begin + chunk]):
            output.wait(0.02)
            collected.add(output.receive())
        if paced:
            due_s = begin_s + (begin + chunk) / rate_hz
            while time.monotonic() < due_s:
                output.wait(max(0.001, due_s - time.monotonic()))
                collected.add(output.receive())


def finish(session: Session, output: Subscription, collected: Collected) -> None:
    """End the audio and collect the rest; the recognizer must have no complaint."""
    while not session.finish():
        output.wait(0.02)
        collected.add(output.receive())
    end_s = time.monotonic() + 60
    while not collected.ended:
        assert time.monotonic() < end_s, "the last frame did not come"
        output.wait(0.2)
        collected.add(output.receive())
        assert list(session.errors()) == []
    collected.add(output.receive())
