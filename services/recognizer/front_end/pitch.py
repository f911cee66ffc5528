"""Pitch of speech, slice by slice as it comes.

Source: P. Ghahremani et al., "A pitch extraction algorithm tuned for automatic speech recognition",
ICASSP 2014, as in kaldi-native-fbank.
"""

from __future__ import annotations

import math

import kaldi_native_fbank
import numpy as np
from numpy.typing import NDArray

from shared.clock import MEDIA_RATE_HZ

_SLICE_MS = 20.0
_FULL_SCALE = 32768.0  # Kaldi's samples are 16-bit integers
# Kaldi's feature (1.0001 - NCCF)^0.15 - 1, doubled: the normalised cross-correlation is over 0.8
_VOICED = -0.43
# The tracker keeps all it has heard. It starts again in the first pause after a while, at last in
# whatever is heard.
_RESTART_S, _LONGEST_S = 10.0, 30.0


class Pitch:
    """Follows the fundamental frequency of a voice."""

    def __init__(self) -> None:
        self._options = kaldi_native_fbank.PitchExtractionOptions()
        self._options.samp_freq = MEDIA_RATE_HZ
        self._options.frame_shift_ms = _SLICE_MS
        self._options.nccf_ballast_online = True
        self._options.simulate_first_pass_online = True  # the newest frame is ready at once
        self._options.frames_per_chunk = 1
        self._outputs = kaldi_native_fbank.ProcessPitchOptions()
        self._outputs.add_raw_log_pitch = True
        self._outputs.add_normalized_log_pitch = self._outputs.add_delta_pitch = False
        self._outputs.normalization_right_context = 0
        self._start()

    def _start(self) -> None:
        self._tracker = kaldi_native_fbank.OnlinePitch(self._options, self._outputs)
        self._heard_s = 0.0

    def accept_slice(self, samples: NDArray[np.float32]) -> float:
        """Take the next 20 ms, 16 kHz mono, shape (320,); return the pitch in Hz, 0 if unvoiced.

        The pitch is that of some 10 ms before the end.
        """
        self._tracker.accept_waveform(MEDIA_RATE_HZ, (samples * _FULL_SCALE).tolist())
        self._heard_s += _SLICE_MS / 1e3
        num_ready = self._tracker.num_frames_ready
        if num_ready == 0:
            return 0.0
        voicing, log_pitch = self._tracker.get_frame(num_ready - 1)
        if voicing < _VOICED and self._heard_s < _LONGEST_S:
            return math.exp(log_pitch)
        if self._heard_s > _RESTART_S:
            self._start()
        return 0.0
