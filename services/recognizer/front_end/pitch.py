"""Pitch of speech, slice by slice.

Source: P. Ghahremani et al., "A pitch extraction algorithm tuned for automatic speech recognition",
ICASSP 2014, as implemented in kaldi-native-fbank.
"""

import math
from typing import Any

import kaldi_native_fbank

from kouxing.shared.arrays import Floats
from kouxing.shared.audio.pcm import FULL_SCALE
from kouxing.shared.clock import MEDIA_RATE_HZ

_SLICE_MS = 20.0
_PITCH_STEP = 0.01  # ratio of neighboring pitches minus 1; half of Kaldi's takes twice the time
# Kaldi's feature (1.0001 - NCCF)^0.15 - 1, doubled: the normalized cross-correlation is over 0.8
_VOICED = -0.43
# Kaldi's tracker keeps all its input, 250 kB a second, so a new tracker replaces it regularly. The
# new tracker starts earlier, so that both agree.
_REPLACE_AFTER_SLICES = 80
_OVERLAP_SLICES = 20


class PitchTracker:
    """Tracks the fundamental frequency of a voice.

    ``num_before`` slices of the session precede the first one. A tracker that starts late gives
    the same results after a few slices.
    """

    def __init__(self, num_before: int = 0) -> None:
        self._options = kaldi_native_fbank.PitchExtractionOptions()
        self._options.samp_freq = MEDIA_RATE_HZ
        self._options.frame_shift_ms = _SLICE_MS
        self._options.delta_pitch = _PITCH_STEP
        self._options.nccf_ballast_online = True
        self._options.simulate_first_pass_online = True  # the newest frame is ready immediately
        self._options.frames_per_chunk = 1
        self._outputs = kaldi_native_fbank.ProcessPitchOptions()
        self._outputs.add_raw_log_pitch = True
        self._outputs.add_normalized_log_pitch = self._outputs.add_delta_pitch = False
        self._outputs.normalization_right_context = 0
        self._trackers = [self._new_tracker()]  # the older one first
        self._num_slices = num_before

    def _new_tracker(self) -> Any:
        return kaldi_native_fbank.OnlinePitch(self._options, self._outputs)

    def track(self, samples: Floats) -> float:
        """Return the pitch in Hz after the next 20 ms, 16 kHz mono, shape (320,); 0 if unvoiced.

        The pitch is measured about 10 ms before the end.
        """
        scaled = (samples * FULL_SCALE).tolist()  # Kaldi expects 16-bit samples
        if self._num_slices % _REPLACE_AFTER_SLICES == _REPLACE_AFTER_SLICES - _OVERLAP_SLICES:
            self._trackers.append(self._new_tracker())
        for tracker in self._trackers:
            tracker.accept_waveform(MEDIA_RATE_HZ, scaled)
        self._num_slices += 1
        older = self._trackers[0]
        if self._num_slices % _REPLACE_AFTER_SLICES == 0:
            self._trackers = self._trackers[-1:]
        if older.num_frames_ready == 0:
            return 0.0
        voicing, log_pitch = older.get_frame(older.num_frames_ready - 1)
        return math.exp(log_pitch) if voicing < _VOICED else 0.0
