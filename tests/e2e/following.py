"""Streams audio through a running system and collects what comes out."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from kouxing_client import Client, FapFrame, Phone, Result, Results, Session, Sound, Speech
from kouxing_client.messages import Floats
from numpy.typing import NDArray

from kouxing.shared.audio_file import read_audio


class LipPositions(Result, frozen=True, kw_only=True):
    """The mouth from a lip model that works on the audio itself."""

    kind: ClassVar[str] = "lip-positions"

    values: Floats
    delay: int
    closure: float
    lip_to_teeth: float


KINDS: tuple[type[Result], ...] = (FapFrame, Phone, LipPositions, Speech, Sound)


@dataclass
class Collected:
    frames: list[FapFrame] = field(default_factory=list)
    phones: list[Phone] = field(default_factory=list)
    lips: list[LipPositions] = field(default_factory=list)
    speech: list[Speech] = field(default_factory=list)
    sounds: list[Sound] = field(default_factory=list)

    def add(self, results: Iterable[Result]) -> None:
        for result in results:
            match result:
                case FapFrame():
                    self.frames.append(result)
                case Phone():
                    self.phones.append(result)
                case LipPositions():
                    self.lips.append(result)
                case Speech():
                    self.speech.append(result)
                case Sound():
                    self.sounds.append(result)

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
    output = session.results(*KINDS, keep_all=True)
    collected = Collected()
    send(session, samples, output, collected, chunk=chunk, rate_hz=rate_hz, paced=paced)
    finish(session, output, collected)
    return collected


def send(
    session: Session,
    samples: NDArray[np.float32],
    output: Results[Any],
    collected: Collected,
    *,
    chunk: int = 320,
    rate_hz: int = 16000,
    paced: bool = False,
) -> None:
    """Send samples, and collect results at the same time."""
    begin_s = time.monotonic()
    for begin in range(0, len(samples), chunk):
        session.push(samples[begin : begin + chunk])
        due_s = begin_s + (begin + chunk) / rate_hz if paced else 0.0
        collected.add(output.available())
        while (left_s := due_s - time.monotonic()) > 0:
            collected.add(output.available(left_s))


def finish(session: Session, output: Results[Any], collected: Collected) -> None:
    """End the audio and collect the rest; the recognizer must not complain."""
    session.finish()
    end_s = time.monotonic() + 60
    while not output.has_ended:
        assert time.monotonic() < end_s, "the last frame did not come"
        collected.add(output.available(0.2))
        assert session.take_errors() == []
    collected.add(output.available())
