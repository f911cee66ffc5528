"""Stream audio into a session and collect its results."""

import time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from kouxing_client import Client, FapFrame, Phone, Result, Session, Sound, Speech
from numpy.typing import NDArray

from tests.system import wait_until

RATE_HZ = 16000


class LipPositions(Result, frozen=True, kw_only=True):
    """Lip positions, which are no part of the public client."""

    kind: ClassVar[str] = "lip-positions"

    values: bytes
    delay_samples: int
    closure: float
    lip_to_teeth: float


class StreamedSession:
    """A session and everything that it has published."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.num_sent = 0  # samples
        self.frames: list[FapFrame] = []
        self.phones: list[Phone] = []
        self.lips: list[LipPositions] = []
        self.speech: list[Speech] = []
        self.sounds: list[Sound] = []
        self._lists: dict[type[Result], list[Any]] = {
            FapFrame: self.frames,
            Phone: self.phones,
            LipPositions: self.lips,
            Speech: self.speech,
            Sound: self.sounds,
        }
        self._output = session.results(*self._lists, keep_all=True)

    def send(
        self,
        samples: NDArray[Any],
        *,
        chunk: int = 320,
        rate_hz: int = RATE_HZ,
        paced: bool = False,
    ) -> None:
        """Send samples, and collect results at the same time."""
        begin_s = time.monotonic()
        for begin in range(0, len(samples), chunk):
            self.session.push(samples[begin : begin + chunk])
            self.num_sent += len(samples[begin : begin + chunk])
            due_s = begin_s + (begin + chunk) / rate_hz if paced else 0.0
            self.collect()
            while (left_s := due_s - time.monotonic()) > 0:
                self.collect(left_s)

    def collect(self, wait_s: float = 0.0) -> None:
        for result in self._output.available(wait_s):
            self._lists[type(result)].append(result)

    def collect_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, step=lambda: self.collect(0.1))

    def finish(self) -> None:
        """End the audio and collect the rest; the recognizer must not complain."""
        self.session.finish()
        self.collect_until(lambda: self._output.has_ended)
        assert self.session.take_errors() == []
        self.collect()

    @property
    def times(self) -> list[int]:
        """Media times of all frames."""
        return [frame.media_time for frame in self.frames]

    @property
    def faps(self) -> NDArray[np.float32]:
        """FAPs of all frames, shape (frames, 68)."""
        return np.array([np.frombuffer(frame.values, "<f4") for frame in self.frames])

    @property
    def symbols(self) -> list[str]:
        """The final phones, in order."""
        last = {phone.index: phone.symbol for phone in self.phones}
        return [last[index] for index in sorted(last)]


def stream_audio(
    control: str,
    samples: NDArray[Any],
    *,
    chunk: int = 320,
    sample_rate_hz: int = RATE_HZ,
    paced: bool = False,
    **options: Any,
) -> StreamedSession:
    """Stream samples, paced or as fast as possible, and wait for the last frame."""
    options = {"encoding": "f32le", **options}
    options |= {"sample_rate_hz": sample_rate_hz, "paced": paced}
    with Client(control) as client, client.open_session(**options) as session:
        streamed = StreamedSession(session)
        streamed.send(samples, chunk=chunk, rate_hz=sample_rate_hz, paced=paced)
        streamed.finish()
    return streamed
