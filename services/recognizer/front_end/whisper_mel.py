"""The front end of the networks: Whisper's log-mel bands, live.

Source: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision", section
2.2; the mel scale and the bands follow Slaney 1998, "Auditory toolbox".

    m[t, k] = (log10(max(sum_f B[f, k] |X[t, f]|^2, 1e-7)) + 4) / 4

======== ================================================================ =============
symbol   meaning                                                          shape
======== ================================================================ =============
x        samples at 16 kHz, in [-1, 1]                                    (n,)
X        spectrum of 25 ms under a periodic Hann window, no pre-emphasis  (frames, 201)
B        triangles of equal area, 0 to 8000 Hz                            (201, 80)
m        log-mel bands                                                    (frames, 80)
======== ================================================================ =============

Deviations from Whisper, which has the whole recording: frame ``t`` begins at ``t * 10`` ms instead
of being centered there, so it needs samples up to ``t * 10 + 25`` ms. The floor is a fixed power;
Whisper's is eight decades below the recording's loudest band (``FLOOR_BANDS``).

kaldi-native-fbank's ``OnlineWhisperFbank`` frames the audio differently: its bands differ from
these by up to 0.8, and the shipped networks were trained on these.

Cost: about 1 ms per second of audio in chunks of 10 ms.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.front_end.features import (
    HOP_SAMPLES,
    SAMPLE_RATE_HZ,
    WINDOW_SAMPLES,
    count_frames,
)
from kouxing.shared.arrays import Doubles, Floats, Integers

NUM_MELS = 80
FLOOR_BANDS = 2.0  # Whisper's floor, below the loudest band: eight decades

_FLOOR = 1e-7  # power
_HZ_PER_MEL = 200 / 3  # below the knee; Slaney's mels
_KNEE_HZ = 1000.0
_LOG_STEP = math.log(6.4) / 27  # a mel above the knee
_HANN = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(WINDOW_SAMPLES) / WINDOW_SAMPLES)


def mel_bands() -> Doubles:
    """Return the weights of the bands, B, shape (201, 80)."""
    knee = _KNEE_HZ / _HZ_PER_MEL
    highest = knee + math.log(SAMPLE_RATE_HZ / 2 / _KNEE_HZ) / _LOG_STEP
    mel = np.linspace(0, highest, NUM_MELS + 2)
    edges = np.where(mel < knee, mel * _HZ_PER_MEL, _KNEE_HZ * np.exp(_LOG_STEP * (mel - knee)))
    hz = np.fft.rfftfreq(WINDOW_SAMPLES, 1 / SAMPLE_RATE_HZ)[:, None]
    low, center, high = edges[:-2], edges[1:-1], edges[2:]
    triangles = np.minimum((hz - low) / (center - low), (high - hz) / (high - center))
    bands: Doubles = np.maximum(triangles, 0) * 2 / (high - low)
    return bands


_BANDS = mel_bands()
# First bin of the spectrum in each band, and the first after it.
_EDGES = np.array([(band.nonzero()[0][0], band.nonzero()[0][-1] + 1) for band in _BANDS.T])


class WhisperMel:
    """Streaming log-mel bands; any chunking gives the same frames."""

    def __init__(self) -> None:
        self._samples = np.empty(0, dtype=np.float32)

    def accept_waveform(self, samples: Floats) -> Floats:
        """Accept samples, (n,), 16 kHz, in [-1, 1]; return the new feature frames, (frames, 80)."""
        known = np.concatenate([self._samples, samples.astype(np.float32, copy=False)])
        num_frames = count_frames(len(known))
        self._samples = known[HOP_SAMPLES * num_frames :]
        if num_frames == 0:
            return np.empty((0, NUM_MELS), dtype=np.float32)
        # Each row is transformed and summed separately, in a fixed order: chunks do not matter.
        return _log_mel(np.fft.rfft(_windows(known, _HANN, num_frames)), _BANDS, _EDGES)


@numba.njit(cache=True, nogil=True)
def _windows(samples: Floats, window: Doubles, num_frames: int) -> Doubles:
    out = np.empty((num_frames, len(window)))
    for row in range(num_frames):
        for k in range(len(window)):
            out[row, k] = window[k] * samples[HOP_SAMPLES * row + k]
    return out


@numba.njit(cache=True, nogil=True)
def _log_mel(spectrum: NDArray[np.complex128], bands: Doubles, edges: Integers) -> Floats:
    num_rows, num_bins = spectrum.shape
    out = np.empty((num_rows, len(edges)), dtype=np.float32)
    power = np.empty(num_bins)
    for row in range(num_rows):
        for k in range(num_bins):
            power[k] = spectrum[row, k].real ** 2 + spectrum[row, k].imag ** 2
        for band in range(len(edges)):
            total = 0.0
            for k in range(edges[band, 0], edges[band, 1]):
                total += bands[k, band] * power[k]
            out[row, band] = np.float32((math.log10(max(total, _FLOOR)) + 4.0) / 4.0)
    return out
