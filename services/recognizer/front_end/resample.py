"""Resampling of microphone audio to 16 kHz, one channel, 32-bit float.

Windowed-sinc interpolation at rational positions (Crochiere and Rabiner 1983, "Multirate digital
signal processing", chapter 2), with a table of the filter at every phase:

    y[n] = sum_k x[k] h(n M / L - k),   h(t) = 2 f sinc(2 f t) w(t / W)

======== ============================================================ =================
symbol   meaning                                                      unit, value
======== ============================================================ =================
x, y     samples before and after
L / M    16000 over the input's rate, in lowest terms
f        cutoff: 15/16 of half the lower of the two rates             cycles per sample
w        Kaiser window, beta 8: aliases are 80 dB down
W        half width of the filter: 32 samples of the lower rate       samples
======== ============================================================ =================

The delay is W: 2 ms for rates above 16 kHz, 4 ms from 8 kHz. The SoX library, which resamples
training data and files elsewhere, works in blocks. It would add up to 37 ms of delay from 48 kHz,
and 115 ms from 8 kHz. The sums run in a fixed order, so the result does not depend on the chunks.

For rates with more than 640 phases, the table has 640, and the filter is interpolated between them.
The error is at most (pi / 640)² / 8, which is -110 dB.
"""

from functools import lru_cache
from math import gcd

import numba
import numpy as np

from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.shared.arrays import Floats

_HALF_WIDTH = 32  # samples of the lower rate
_CUTOFF = 15 / 16  # relative to half the lower rate
_KAISER_BETA = 8.0
_MAX_PHASES = 640  # as for 11,025 Hz; the 16,000 phases of 47,999 Hz would take seconds to compute


class Resampler:
    """Streaming resampler from 8 to 48 kHz to 16 kHz mono; averages the channels."""

    def __init__(self, sample_rate_hz: int) -> None:
        self._rate_hz = sample_rate_hz
        self._filter = _filter_table(sample_rate_hz)
        half = self._filter.shape[1] // 2
        self._known = np.zeros(half, dtype=np.float32)  # recent input, zeros at first
        self._first = -half  # index of the first of these
        self._num_in = 0
        self._num_out = 0

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept finite samples, (n,) or (n, channels); return the new samples at 16 kHz, (m,)."""
        mono = _mix_and_clip(samples)
        self._num_in += len(mono)
        return mono if self._rate_hz == SAMPLE_RATE_HZ else self._resample(mono)

    def finish(self) -> Floats:
        """Return the remaining samples at the end of the stream."""
        if self._rate_hz == SAMPLE_RATE_HZ:
            return np.empty(0, dtype=np.float32)
        half = self._filter.shape[1] // 2
        rest = self._resample(np.zeros(half, dtype=np.float32))
        num_total = -(-self._num_in * SAMPLE_RATE_HZ // self._rate_hz)  # rounded up
        return rest[: len(rest) - max(0, self._num_out - num_total)]

    def _resample(self, mono: Floats) -> Floats:
        self._known = np.concatenate([self._known, mono])
        up, down = _ratio(self._rate_hz)
        half = self._filter.shape[1] // 2
        # The filter around position n M / L reaches from floor - half + 1 to floor + half.
        end = self._first + len(self._known)
        num_ready = max(0, -(-(end - half) * up // down) - self._num_out)
        out = np.empty(num_ready, dtype=np.float32)
        _interpolate(self._known, self._first, self._filter, self._num_out, up, down, out)
        self._num_out += num_ready
        drop = max(0, self._num_out * down // up - half + 1 - self._first)
        self._known, self._first = self._known[drop:], self._first + drop
        return out


def to_16_khz(samples: Floats, sample_rate_hz: int) -> Floats:
    """Resample a whole recording of shape (n,) or (n, channels) to 16 kHz mono."""
    resampler = Resampler(sample_rate_hz)
    return np.concatenate([resampler.accept_waveform(samples), resampler.finish()])


def _mix_and_clip(samples: Floats) -> Floats:
    """Return samples as one channel, (n,), in [-1, 1]."""
    has_channels = samples.ndim == 2 and samples.shape[1] > 1
    mono = samples.mean(axis=1) if has_channels else samples.reshape(-1)
    clipped: Floats = np.minimum(np.maximum(mono, -1.0), 1.0)
    return clipped.astype(np.float32, copy=False)


def _ratio(rate_hz: int) -> tuple[int, int]:
    """Return L and M."""
    common = gcd(SAMPLE_RATE_HZ, rate_hz)
    return SAMPLE_RATE_HZ // common, rate_hz // common


@lru_cache(maxsize=8)
def _filter_table(rate_hz: int) -> Floats:
    """Return the filter at n = min(L, 640) phases and at the next sample, (n + 1, taps).

    Row p is for positions p / n after a sample.
    """
    num_phases = min(_ratio(rate_hz)[0], _MAX_PHASES)
    lower = min(1.0, SAMPLE_RATE_HZ / rate_hz)  # the lower rate over the input's
    half = int(np.ceil(_HALF_WIDTH / lower))
    offset = np.arange(1 - half, half + 1)  # samples from the one at or before the position
    time = np.arange(num_phases + 1)[:, None] / num_phases - offset
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0, 1 - (time / half) ** 2)))
    table = np.sinc(_CUTOFF * lower * time) * window
    table /= table.sum(axis=1, keepdims=True)  # every phase keeps a constant signal
    return table.astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _interpolate(
    known: Floats, first: int, table: Floats, num_before: int, up: int, down: int, out: Floats
) -> None:
    num_taps, num_phases = table.shape[1], len(table) - 1
    for index in range(len(out)):
        position = (num_before + index) * down
        begin = position // up - num_taps // 2 + 1 - first
        phase = position % up * num_phases
        row, rest = phase // up, phase % up
        value = _filter(known, begin, table[row])
        if rest:
            following = _filter(known, begin, table[row + 1])
            value += np.float32(rest / up) * (following - value)
        out[index] = value


@numba.njit(cache=True, nogil=True)
def _filter(known: Floats, begin: int, weights: Floats) -> np.float32:
    total = np.float32(0.0)
    for tap in range(len(weights)):
        total += weights[tap] * known[begin + tap]
    return total
