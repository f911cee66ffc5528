"""The sound check: some beeps to count, so that whoever cannot hear is told before judging."""

from __future__ import annotations

import io
import wave

import numpy as np

_RATE_HZ = 24000
_PITCH_HZ = 880.0
_BEEP_S = 0.2
_GAP_S = 0.4


def make_beeps(num_beeps: int) -> bytes:
    """Return a WAV file with so many beeps."""
    time_s = np.arange(round(_BEEP_S * _RATE_HZ)) / _RATE_HZ
    beep = 0.3 * np.sin(2 * np.pi * _PITCH_HZ * time_s) * np.hanning(len(time_s))
    gap = np.zeros(round(_GAP_S * _RATE_HZ))
    samples = np.concatenate([gap, *[beep, gap] * num_beeps])
    content = io.BytesIO()
    with wave.open(content, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(_RATE_HZ)
        file.writeframes((samples * 32767).astype("<i2").tobytes())
    return content.getvalue()
