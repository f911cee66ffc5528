"""Vocal-tract-length normalization (VTLN) of low voices, estimated from their pitch.

Sources: Faria and Gelbart 2005, "Efficient pitch-based estimation of VTLN warp factors": a low
voice usually comes from a long vocal tract, and a long tract has low formants. The pitch comes from
the normalized cross-correlation of Talkin 1995, "A robust algorithm for pitch tracking", without
its dynamic programming, because a mean over many frames tolerates single errors.

    phi[l] = sum_i y[i] y[i - l] / sqrt(sum_i y[i]^2 sum_i y[i - l]^2 + floor)
    a = clip((f_ref / f_mean)^beta, 1, 1.3)
    out(f) = in(f / a)

======== ============================================================= ====================
symbol   meaning                                                       unit, value, shape
======== ============================================================= ====================
x        samples at 16 kHz, in [-1, 1]                                 (n,)
y        x below 900 Hz, every fourth sample: 4 kHz
l        lag: 10 to 58, so peaks are at 70 to 380 Hz                   samples of y
phi      correlation at a lag: 1 if the last 20 ms repeat the audio    (49,)
         one lag earlier
f_ref    pitch of a voice that is not warped                           220 Hz
f_mean   geometric mean of the speaker's pitch so far, starting        Hz
         from 20 frames of f_ref
beta     part of the pitch ratio that is due to the tract              0.2
a        warp factor: formants are multiplied by it                    1 to 1.3
in, out  log-mel bands as functions of their center frequency          (40,)
======== ============================================================= ====================

Reason: a recognizer trained mostly on high voices mistakes the low formants of a long tract for
other vowels. With a small recurrent network, VTLN lowered the phone error rate of 14 unseen low
voices from 35.4 to 32.1 %. That of high voices stayed about the same (24.8 and 24.3 %).

Deviations from the paper:

- The paper models the distribution of the factor given the pitch. Here the factor is a power of the
  pitch, so there is nothing to train.
- The mean is a running mean with forgetting, as live use requires.
- Only low voices are warped, because only they are rare in the training data.
- The log-mel bands are interpolated. Their filters stay in place, because the audio is no longer
  available.

Only the Gaussian mixture model uses VTLN: the networks learned low voices from data. Kaldi's
tracker (:mod:`.pitch`) gives other values than this one, which would change the model's scores.

Cost: about 1 ms per second of audio. A frame's pitch depends on the samples up to the frame's end,
so VTLN adds no delay to the features. The sums run in a fixed order, so the result does not
depend on the chunks.
"""

import math

import numba
import numpy as np

from kouxing.services.recognizer.front_end.features import (
    BAND_HZ,
    HIGHEST_MEL,
    HOP_S,
    LOWEST_MEL,
    MEL_KNEE_HZ,
    MELS,
    NUM_BANDS,
    SAMPLE_RATE_HZ,
    WINDOW_S,
    LogMel,
)
from kouxing.shared.arrays import Doubles, Floats

_DECIMATION = 4
_RATE_HZ = SAMPLE_RATE_HZ / _DECIMATION
_CUTOFF_HZ = 900.0
_NUM_TAPS = 49
# all at 4 kHz
_WINDOW_SAMPLES = 80
_MIN_LAG_SAMPLES = 10
_MAX_LAG_SAMPLES = 58
_SPAN_SAMPLES = _WINDOW_SAMPLES + _MAX_LAG_SAMPLES
_HOP_SAMPLES = round(HOP_S * _RATE_HZ)
_FRAME_SAMPLES = round(WINDOW_S * _RATE_HZ)
_ENERGY_FLOOR = 1e-9  # squared energy: below -60 dB of full scale, the strength approaches 0
_PEAK_RATIO = 0.88  # relative to the highest; the first peak above it is the period, not a multiple

VOICED_STRENGTH = 0.8  # only frames above it count in the mean pitch
REFERENCE_HZ = 220.0
MAX_FACTOR = 1.3
_EXPONENT = 0.2
_PRIOR_FRAMES = 20.0  # weight of the reference
_MEMORY_FRAMES = 1500.0  # like the live mean of the features

_STEP_MEL = float(HIGHEST_MEL - LOWEST_MEL) / (NUM_BANDS + 1)
_LOWEST_MEL = float(LOWEST_MEL)


def _low_pass_taps() -> Doubles:
    """Return a windowed sinc of unit gain."""
    time = np.arange(_NUM_TAPS) - (_NUM_TAPS - 1) / 2
    taps = np.sinc(2 * _CUTOFF_HZ / SAMPLE_RATE_HZ * time) * np.hamming(_NUM_TAPS)
    normalized: Doubles = taps / taps.sum()
    return normalized


_TAPS = _low_pass_taps()


class PitchedLogMel:
    """Streaming log energy and log-mel bands with the pitch; any chunking gives the same frames."""

    def __init__(self) -> None:
        self._log_mel = LogMel()
        # The zeros before the first sample make frame 0 end at its last sample.
        self._samples = np.zeros(_NUM_TAPS - _DECIMATION, dtype=np.float32)
        self._low = np.zeros(_SPAN_SAMPLES - _FRAME_SAMPLES)

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept samples, shape (n,), 16 kHz, in [-1, 1].

        Returns the new feature frames, shape (frames, 43): log energy, 40 log-mel bands, the pitch
        (70 to 380 Hz, or 0 if unvoiced) and its strength, 0 to 1, above ``VOICED_STRENGTH`` in
        voiced sounds.
        """
        self._samples = np.concatenate([self._samples, samples.astype(np.float32, copy=False)])
        low = np.empty(max(0, (len(self._samples) - _NUM_TAPS) // _DECIMATION + 1))
        _low_pass(self._samples, _TAPS, low)
        self._samples = self._samples[_DECIMATION * len(low) :]
        self._low = np.concatenate([self._low, low])
        num_ready = max(0, (len(self._low) - _SPAN_SAMPLES) // _HOP_SAMPLES + 1)
        pitch_hz = np.empty(num_ready, dtype=np.float32)
        strength = np.empty(num_ready, dtype=np.float32)
        _track(self._low, pitch_hz, strength)
        self._low = self._low[_HOP_SAMPLES * num_ready :]
        return np.column_stack([self._log_mel.accept_waveform(samples), pitch_hz, strength])


class VocalTractNormalizer:
    """Warps the mel bands of a low voice upward, depending on the mean pitch so far."""

    def __init__(self) -> None:
        self.reset()

    @property
    def factor(self) -> float:
        """Current warp factor of the speaker's formants, 1 to 1.3."""
        return float(_warp_factor(self._state))

    def warp(self, log_mel: Floats, pitch_hz: Floats, strength: Floats) -> Floats:
        """Warp feature frames of speech, given their pitch and its strength, (n,) each.

        Returns frames like ``log_mel``, (n, 41): the log energy unchanged, the bands warped by the
        factor at their frame. A factor of 1 changes no bit.
        """
        frames = np.array(log_mel, dtype=np.float32, order="C")
        _warp(frames, np.column_stack([pitch_hz, strength]), BAND_HZ, self._state)
        return frames

    def reset(self) -> None:
        """Reset the speaker's statistics."""
        self._state = np.zeros(2)  # sum of ln(f_ref / pitch) over voiced frames; their number


@numba.njit(cache=True, nogil=True)
def _low_pass(samples: Floats, taps: Doubles, out: Doubles) -> None:
    for row in range(len(out)):
        total = 0.0
        for tap in range(len(taps)):
            total += taps[tap] * samples[_DECIMATION * row + tap]
        out[row] = total


@numba.njit(cache=True, nogil=True)
def _track(low: Doubles, pitch_hz: Floats, strength: Floats) -> None:
    for frame in range(len(pitch_hz)):
        phi = _correlation(low[_HOP_SAMPLES * frame : _HOP_SAMPLES * frame + _SPAN_SAMPLES])
        lag, peak = _period(phi)
        pitch_hz[frame] = np.float32(_RATE_HZ / lag if lag > 0.0 else 0.0)
        strength[frame] = np.float32(peak)


@numba.njit(cache=True, nogil=True)
def _correlation(low: Doubles) -> Doubles:
    """Return the normalized cross-correlation (Talkin 1995) of the last window at each lag."""
    num_lags = _MAX_LAG_SAMPLES - _MIN_LAG_SAMPLES + 1
    low = low - low.mean()  # an offset would look like a pitch
    product = np.zeros(num_lags)
    energy_before = np.zeros(num_lags)
    energy = 0.0
    for now in range(_MAX_LAG_SAMPLES, _SPAN_SAMPLES):
        energy += low[now] * low[now]
        for k in range(num_lags):
            before = low[now - _MIN_LAG_SAMPLES - k]
            product[k] += low[now] * before
            energy_before[k] += before * before
    return product / np.sqrt(energy * energy_before + _ENERGY_FLOOR)


@numba.njit(cache=True, nogil=True)
def _period(phi: Doubles) -> tuple[float, float]:
    """Return lag and height of the first good peak, interpolated by a parabola, or zeros."""
    threshold = _PEAK_RATIO * phi.max()
    for k in range(1, len(phi) - 1):
        left, middle, right = phi[k - 1], phi[k], phi[k + 1]
        if middle >= threshold and middle >= left and middle >= right and middle > 0.0:
            bend = left - 2.0 * middle + right
            offset = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
            return _MIN_LAG_SAMPLES + k + offset, middle
    return 0.0, 0.0


@numba.njit(cache=True, nogil=True)
def _warp_factor(state: Doubles) -> float:
    log_ratio = state[0] / (_PRIOR_FRAMES + state[1])  # log of reference over mean
    return min(max(math.exp(_EXPONENT * log_ratio), 1.0), MAX_FACTOR)


@numba.njit(cache=True, nogil=True)
def _warp(frames: Floats, voice: Floats, centers_hz: Doubles, state: Doubles) -> None:
    keep = 1.0 - 1.0 / _MEMORY_FRAMES
    num_bands = len(centers_hz)
    for row in range(len(frames)):
        if voice[row, 1] > VOICED_STRENGTH:
            state[0] = keep * state[0] + math.log(REFERENCE_HZ / voice[row, 0])
            state[1] = keep * state[1] + 1.0
        factor = _warp_factor(state)
        if factor == 1.0:
            continue
        # From the top down, because a band is computed from the old values at or below it.
        for k in range(num_bands - 1, -1, -1):
            mel = MELS * math.log1p(centers_hz[k] / factor / MEL_KNEE_HZ)
            position = max((mel - _LOWEST_MEL) / _STEP_MEL - 1.0, 0.0)
            below = min(int(position), num_bands - 2)
            fraction = np.float32(position - below)
            band = frames[row, 1 + below : 3 + below]
            frames[row, 1 + k] = (np.float32(1.0) - fraction) * band[0] + fraction * band[1]
