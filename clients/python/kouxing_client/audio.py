"""Audio of one session: conversion to PCM, and the queue until the recognizer acknowledges it."""

from __future__ import annotations

import sys
from array import array
from collections import deque
from collections.abc import Iterable, Iterator
from math import isfinite
from typing import Any

from kouxing_client.errors import KouxingError
from kouxing_client.messages import MEDIA_RATE_HZ, Fields

SAMPLE_BYTES = {"s16le": 2, "f32le": 4}
_CODES = {"s16le": "h", "f32le": "f"}
_NATIVE_ORDER = "=<" if sys.byteorder == "little" else "=>"  # prefixes of a buffer's format
_FULL_SCALE = 32768  # as in the services
_EXPECTED = "audio must be 16-bit integers (array type int16), or floats within ±1"
MAX_FLOAT = 8.0  # smaller values beyond 1 are clipped
# Audio before the newest acknowledgement that is kept in case another recognizer needs it
RESEND_S = 10.0
MAX_KEPT_MESSAGES = 5000
# Shortest and longest wait for an acknowledgement before reconnecting
ANSWER_LIMITS_S = (0.6, 10.0)
UNPACED_ANSWER_S = 5.0  # shortest wait if audio arrives faster than real time and may queue
MIN_CONNECT_MS = 50  # shortest limit for making a connection
QUICK_ANSWER_S = 2.5  # up to this wait, the round trip measured before limits a new connection
MAX_TIMED_MESSAGES = 200  # messages whose send time is remembered


def check_channels(audio: Any, num_channels: int) -> None:
    """Raise ``KouxingError`` if audio is an array with another number of channels."""
    shape = getattr(audio, "shape", ())
    if len(shape) > 1 and shape[1:] != (num_channels,):
        raise KouxingError(
            f"the audio has the shape {shape}, but the session has num_channels={num_channels};"
            f" push an array of shape (n, {num_channels}), or set num_channels to match the audio"
        )


def to_pcm(audio: Any, encoding: str) -> bytes:
    """Convert audio to interleaved PCM of an encoding.

    The audio is PCM bytes in that encoding, or numbers (16-bit integers, or floats within ±1) in an
    iterable or a buffer, of shape ``(n,)`` or ``(n, channels)``.

    Raises ``KouxingError`` if it is neither, if floats are not finite or far beyond ±1, or if an
    array has another type.
    """
    try:
        view = memoryview(audio)
    except TypeError:
        view = memoryview(_to_array(audio))
    flat = memoryview(view.tobytes())  # a view with any number of dimensions is flattened
    kind = view.format.lstrip(_NATIVE_ORDER)
    if kind in ("B", "b", "c"):
        return flat.tobytes()
    if kind not in ("h", "f", "d"):  # such as 32-bit integers, or the other byte order
        raise KouxingError(
            f"{_EXPECTED}, in this machine's byte order, not the format {view.format!r}"
        )
    return _pack(flat.cast(kind), encoding)  # type: ignore[call-overload]


def _to_array(numbers: Iterable[float]) -> array[int] | array[float]:
    try:
        listed = list(numbers)
        try:
            return array("h", listed)
        except (TypeError, OverflowError):  # floats, or larger integers
            return array("d", listed)
    except OverflowError:
        raise KouxingError(f"{_EXPECTED}, not larger integers") from None
    except TypeError:
        raise KouxingError(
            f"audio must be bytes or numbers, not {type(numbers).__name__}"
        ) from None


def _pack(numbers: memoryview[Any], encoding: str) -> bytes:
    is_integer = numbers.format == "h"
    if len(numbers) and not is_integer:
        lowest, highest = min(numbers), max(numbers)
        is_finite = isfinite(sum(numbers))  # the sum finds every NaN
        if not (is_finite and -MAX_FLOAT <= lowest <= highest <= MAX_FLOAT):
            raise KouxingError(
                f"{_EXPECTED}, not "
                + (f"{lowest:g} to {highest:g}" if is_finite else "NaN or infinity")
            )
    scaled: Iterable[float] = numbers
    if encoding == "s16le" and not is_integer:
        scaled = (
            max(-_FULL_SCALE, min(_FULL_SCALE - 1, round(_FULL_SCALE * value))) for value in numbers
        )
    elif encoding == "f32le" and is_integer:
        scaled = (value / _FULL_SCALE for value in numbers)
    packed = array(_CODES[encoding], scaled)
    if sys.byteorder == "big":
        packed.byteswap()
    return packed.tobytes()


def split(pcm: bytes, num_bytes: int) -> Iterator[bytes]:
    """Split PCM into chunks of at most ``num_bytes`` bytes."""
    for begin in range(0, len(pcm), num_bytes):
        yield pcm[begin : begin + num_bytes]


class AudioStream:
    """Numbers audio messages, keeps them while they may be needed, and detects a dead connection.

    It has no I/O; the caller passes the time. ``is_paced``: the audio arrives in real time.
    """

    def __init__(self, sample_rate_hz: int, *, is_paced: bool) -> None:
        self.sequence = 0  # number of the newest message
        self.acknowledged = 0  # number of the newest message that the recognizer has
        self.round_trip_ms: int | None = None  # twice the shortest time to an acknowledgement
        self._sample_rate_hz = sample_rate_hz
        self._num_samples = 0  # in all chunks
        self._kept: deque[Fields] = deque(maxlen=MAX_KEPT_MESSAGES)
        self._next = 1  # number of the next message for the socket
        # sequence and time
        self._send_times: deque[tuple[int, float]] = deque(maxlen=MAX_TIMED_MESSAGES)
        self._progress_s = 0.0  # time of the last acknowledgement, or of the first open message
        self._min_answer_s = ANSWER_LIMITS_S[0] if is_paced else UNPACED_ANSWER_S
        self._answer_s = self._min_answer_s  # how long to wait before reconnecting

    @property
    def media_time(self) -> int:
        """Media time of the next chunk, samples at 16 kHz."""
        return self._num_samples * MEDIA_RATE_HZ // self._sample_rate_hz

    @property
    def num_unacknowledged(self) -> int:
        """Number of messages that the recognizer must still acknowledge; any thread may read it."""
        return min(self.sequence - self.acknowledged, len(self._kept))

    def connect_ms(self, default: int) -> int:
        """Return the time limit for a new connection.

        A packet that is lost while a connection is made costs the whole limit.
        """
        if self.round_trip_ms is None or self._answer_s > QUICK_ANSWER_S:
            return default
        return min(self.round_trip_ms, default)

    def add(self, fields: Fields, num_samples: int, now_s: float) -> None:
        """Add a chunk of ``num_samples`` samples per channel."""
        if self.num_unacknowledged == 0:
            self._progress_s = now_s
        self.sequence += 1
        numbered = {**fields, "sequence": self.sequence, "media_time": self.media_time}
        self._kept.append({**numbered, "acknowledge": True})
        self._send_times.append((self.sequence, now_s))
        self._num_samples += num_samples
        num_acknowledged = self.acknowledged - self._kept[0]["sequence"] + 1
        if num_acknowledged > 0:
            newest = self._kept[min(num_acknowledged, len(self._kept)) - 1]
            oldest = newest["media_time"] - RESEND_S * MEDIA_RATE_HZ
            while self._kept[0]["media_time"] < oldest:
                self._kept.popleft()

    def skip(self, num_samples: int) -> None:
        """Advance media time without audio."""
        self._num_samples += num_samples

    def unsent(self) -> Iterator[Fields]:
        """Yield messages for the socket; requesting the next one marks the last one as sent."""
        while self._kept and self._next <= self.sequence:
            first = self._kept[0]["sequence"]
            self._next = max(self._next, first)
            yield self._kept[self._next - first]
            self._next += 1

    def acknowledge(self, sequence: int, now_s: float) -> None:
        """Mark all messages up to ``sequence`` as received."""
        if sequence <= self.acknowledged:
            return
        while self._send_times and self._send_times[0][0] <= sequence:
            number, sent_s = self._send_times.popleft()
            if number == sequence:
                measured_ms = max(round(2e3 * (now_s - sent_s)), MIN_CONNECT_MS)
                self.round_trip_ms = min(measured_ms, self.round_trip_ms or measured_ms)
        self.acknowledged = min(sequence, self.sequence)
        self._progress_s = now_s
        self._answer_s = max(self._min_answer_s, self._answer_s / 2)

    def is_stuck(self, now_s: float) -> bool:
        """Return whether acknowledgements have stopped, so the connection may be dead."""
        return self.num_unacknowledged > 0 and now_s - self._progress_s > self._answer_s

    def resend(self, now_s: float) -> None:
        """Send unacknowledged messages again, and wait longer for the next acknowledgement."""
        self._answer_s = min(2 * self._answer_s, ANSWER_LIMITS_S[1])
        self._next = self.acknowledged + 1
        self._progress_s = now_s

    def move(self, next_sequence: int, now_s: float) -> None:
        """Continue at another recognizer, which needs messages from ``next_sequence`` on."""
        self.acknowledged = next_sequence - 1
        self._next = next_sequence
        self._progress_s = now_s

    def flush(self) -> int:
        """Discard all audio without sending or resending it. Return the newest sequence number."""
        self._kept = deque(
            (message for message in self._kept if "last" in message), maxlen=MAX_KEPT_MESSAGES
        )
        return self.sequence
