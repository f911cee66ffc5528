"""Cepstral features: 39 for each feature frame of 10 ms.

Source: Li et al. 2011, section 3.1: 16 kHz, window 25 ms, hop 10 ms, 12 mel-frequency cepstral
coefficients and energy with first and second differences. Differences follow the HTK book's
regression formula (Young et al. 2009, eq. 5.16).

======== =============================================== ===========
symbol   meaning                                         shape
======== =============================================== ===========
x        samples at 16 kHz, in [-1, 1]                   (n,)
m        log energy and log-mel bands                    (frames, 41)
c        log energy and 12 cepstra                       (frames, 13)
d, dd    first and second difference of c                (frames, 13)
mu       live mean of c                                  (13,)
======== =============================================== ===========

Deviations from the paper:

- Log-mel bands have a floor, so that digital silence is finite without dither.
- A live cepstral mean is subtracted, because microphones differ. The paper's corpus was recorded in
  one laboratory.
- The differences are computed first, so that the moving mean does not affect them.

Algorithmic delay: feature frame ``t`` needs samples up to ``t * 10 + 25`` ms and the
``2 * half_width`` frames after it. That is 25 + 20 ms with ``half_width`` 1, and 25 + 40 ms with
the textbook's 2.
"""

import kaldi_native_fbank as knf
import numba
import numpy as np

from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.pcm import FULL_SCALE
from kouxing.shared.clock import MEDIA_RATE_HZ

SAMPLE_RATE_HZ = MEDIA_RATE_HZ
WINDOW_S = 0.025
HOP_S = 0.010
WINDOW_SAMPLES = round(WINDOW_S * SAMPLE_RATE_HZ)
HOP_SAMPLES = round(HOP_S * SAMPLE_RATE_HZ)
NUM_BANDS = 40
NUM_STATIC = 13  # log energy, then cepstra 1 to 12
NUM_FEATURES = 3 * NUM_STATIC

LOWEST_HZ, HIGHEST_HZ = 40.0, 7600.0  # edges of the filter bank
MELS, MEL_KNEE_HZ = 1127.0, 700.0  # mel = 1127 ln(1 + f / 700)

LOG_FLOOR = 6.0  # a few decibels above the noise of the least significant bit
_MEAN_MEMORY_FRAMES = 1500.0  # the live mean forgets older speech
_PRIOR_FRAMES = 100.0  # weight of the prior mean
_ENERGY_PRIOR_FRAMES = 30.0  # fewer: the level converges faster than the timbre
_PEAK_DECAY = 0.005  # per frame, natural log of power: 2 dB a second
_SPEECH_BELOW_PEAK = 6.9  # natural log of power (30 dB): the mean ignores quieter frames

LOWEST_MEL, HIGHEST_MEL = MELS * np.log1p(np.array([LOWEST_HZ, HIGHEST_HZ]) / MEL_KNEE_HZ)
BAND_MEL = np.linspace(LOWEST_MEL, HIGHEST_MEL, NUM_BANDS + 2)[1:-1]  # centers of the bands
BAND_HZ = MEL_KNEE_HZ * np.expm1(BAND_MEL / MELS)


def _filter_bank() -> knf.OnlineFbank:
    options = knf.FbankOptions()
    options.frame_opts.samp_freq = SAMPLE_RATE_HZ
    options.frame_opts.frame_length_ms = WINDOW_S * 1000
    options.frame_opts.frame_shift_ms = HOP_S * 1000
    options.frame_opts.dither = 0.0  # the same sound gives the same features
    options.frame_opts.snip_edges = True
    options.mel_opts.num_bins = NUM_BANDS
    options.mel_opts.low_freq = LOWEST_HZ
    options.mel_opts.high_freq = HIGHEST_HZ
    options.use_energy = True
    options.energy_floor = 1.0
    return knf.OnlineFbank(options)


def _cepstral_matrix() -> Floats:
    """Return the discrete cosine transform (HTK book, eq. 5.14); row 0 keeps the energy."""
    band = np.arange(NUM_BANDS) + 0.5
    order = np.arange(1, NUM_STATIC)
    matrix = np.zeros((1 + NUM_BANDS, NUM_STATIC))
    matrix[0, 0] = 1.0
    matrix[1:, 1:] = np.sqrt(2 / NUM_BANDS) * np.cos(np.pi / NUM_BANDS * np.outer(band, order))
    return matrix.astype(np.float32)


_CEPSTRAL = _cepstral_matrix()


def frame_time_s(frame: int) -> float:
    """Return the start of a feature frame: halfway between its window's center and the previous."""
    return frame * HOP_S + (WINDOW_S - HOP_S) / 2


def frame_at(time_s: float) -> int:
    """Return the feature frame whose preceding boundary is nearest to a time."""
    return round((time_s - (WINDOW_S - HOP_S) / 2) / HOP_S)


def count_frames(num_samples: int) -> int:
    """Return the number of whole feature frames in a number of samples."""
    return max(0, (num_samples - WINDOW_SAMPLES) // HOP_SAMPLES + 1)


class LogMel:
    """Streaming log energy and log-mel bands; any chunking gives the same frames."""

    def __init__(self) -> None:
        self._bank = _filter_bank()
        self._num_read = 0

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept samples, shape (n,), 16 kHz, in [-1, 1].

        Returns the new feature frames, shape (frames, 41): log energy, 40 log-mel bands.
        """
        # the filter bank expects the scale of 16-bit samples
        self._bank.accept_waveform(SAMPLE_RATE_HZ, (samples * FULL_SCALE).tolist())
        num_ready = self._bank.num_frames_ready
        rows = np.empty((num_ready - self._num_read, 1 + NUM_BANDS), dtype=np.float32)
        for row in range(len(rows)):
            rows[row] = self._bank.get_frame(self._num_read + row)
        self._bank.pop(num_ready - self._num_read)
        self._num_read = num_ready
        return np.maximum(rows, np.float32(LOG_FLOOR))


def compute_cepstra(log_mel: Floats) -> Floats:
    """Compute log energy and cepstra 1 to 12, (frames, 41) to (frames, 13)."""
    static = np.empty((len(log_mel), NUM_STATIC), dtype=np.float32)
    for row in range(len(log_mel)):  # row by row: rounding depends on the number of rows
        static[row] = log_mel[row] @ _CEPSTRAL
    return static


class DeltaFeatures:
    """Streaming first and second differences, from ``half_width`` frames on each side."""

    def __init__(self, half_width: int) -> None:
        self.look_ahead_frames = 2 * half_width
        self._half_width = half_width
        self._context: Floats | None = None

    def append(self, static: Floats) -> Floats:
        """Append static features, shape (n, 13); return the complete rows, (m, 39)."""
        if len(static) == 0:
            return np.empty((0, NUM_FEATURES), dtype=np.float32)
        if self._context is None:  # the first frame is repeated before itself (HTK book, 5.9)
            self._context = np.repeat(static[:1], self.look_ahead_frames, axis=0)
        known = np.concatenate([self._context, static])
        self._context = known[-2 * self.look_ahead_frames :]
        return _append_deltas(known, self._half_width)

    def finish(self) -> Floats:
        """Return the remaining rows at the end, shape (look-ahead, 39)."""
        if self._context is None:
            return np.empty((0, NUM_FEATURES), dtype=np.float32)
        return self.append(np.repeat(self._context[-1:], self.look_ahead_frames, axis=0))


def append_deltas(static: Floats, half_width: int) -> Floats:
    """Append the differences of a whole recording: (frames, 13) to (frames, 39)."""
    look_ahead = 2 * half_width
    before, after = (np.repeat(edge, look_ahead, axis=0) for edge in (static[:1], static[-1:]))
    return _append_deltas(np.concatenate([before, static, after]), half_width)


def compute_cepstra_batch(log_mel: Floats) -> Floats:
    """Like :func:`compute_cepstra` with one matrix product, for training; rounding may differ."""
    return log_mel @ _CEPSTRAL


def _append_deltas(static: Floats, half_width: int) -> Floats:
    steps = range(1, half_width + 1)
    norm = np.float32(sum(2 * step * step for step in steps))

    def differences(values: Floats) -> Floats:
        num_rows = max(0, len(values) - 2 * half_width)
        total = np.zeros((num_rows, values.shape[1]), np.float32)
        for step in steps:
            later, earlier = (values[half_width + sign * step :][:num_rows] for sign in (1, -1))
            total += np.float32(step) / norm * (later - earlier)
        return total

    first = differences(static)
    second = differences(first)
    rows = len(second)
    return np.hstack([static[2 * half_width :][:rows], first[half_width:][:rows], second])


class RunningMean:
    """Subtracts a running mean of speech from features, starting from a prior, (k,)."""

    def __init__(self, prior: Floats) -> None:
        self._prior = prior.astype(np.float64)
        self._prior_frames = np.full(len(prior), _PRIOR_FRAMES)
        self._prior_frames[0] = _ENERGY_PRIOR_FRAMES
        self.reset()

    def normalize(self, features: Floats) -> Floats:
        """Subtract the running mean from the first k features of each row, (n, k or more)."""
        out = features.copy()
        _normalize(out, self._prior, self._prior_frames, self._state)
        return out

    def reset(self) -> None:
        """Reset the speaker's statistics."""
        # sums of the features, their number, the peak of the log energy
        self._state = np.array([*[0.0] * len(self._prior), 0.0, -np.inf])


@numba.njit(cache=True)
def _normalize(features: Floats, prior: Doubles, prior_frames: Doubles, state: Doubles) -> None:
    num_static = prior.shape[0]
    keep = 1.0 - 1.0 / _MEAN_MEMORY_FRAMES
    for row in range(features.shape[0]):
        energy = features[row, 0]
        state[num_static + 1] = max(energy, state[num_static + 1] - _PEAK_DECAY)
        if energy > state[num_static + 1] - _SPEECH_BELOW_PEAK:
            for k in range(num_static):
                state[k] = keep * state[k] + features[row, k]
            state[num_static] = keep * state[num_static] + 1.0
        for k in range(num_static):
            weight = prior_frames[k]
            mean = (weight * prior[k] + state[k]) / (weight + state[num_static])
            features[row, k] -= np.float32(mean)
