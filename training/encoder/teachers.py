"""Teachers of the audio encoder: trained networks that compute targets from clean recordings.

The block network comes from the shipped model. PyTorch runs it on whole recordings. The second
teacher is Whisper's unchanged encoder. The lip teacher
(:mod:`kouxing.training.encoder.lip_teacher`) uses the outputs of both.

======== ==================================================================== =================
symbol   meaning                                                              shape
======== ==================================================================== =================
p        position: the feature frames 2 p and 2 p + 1                         (positions,)
whisper  positions of Whisper's encoder after layers 2, 4 and 6, which have   (positions, 3 w)
         seen the whole recording
phones   posteriors of the phones, of the block network                       (positions, phones)
pitch    log2 of the pitch in Hz; NaN without voice                           (positions,)
level    log10 of the power, relative to the recording's loudest parts        (positions,)
effort   log10 of the ratio of the power in 1 to 5 kHz to that below 1 kHz    (positions,)
======== ==================================================================== =================

Source: Eyben et al. 2016, "The Geneva minimalistic acoustic parameter set (GeMAPS) for voice
research and affective computing" (the effort is its alpha ratio).
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.front_end.pitch import PitchTracker
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.arrays import Floats, Int16
from kouxing.shared.audio.pcm import as_floats
from kouxing.training.blocks.exported import rebuild_encoder, rebuild_readout
from kouxing.training.blocks.network import block_layout
from kouxing.training.device import DEVICE, mixed_precision
from kouxing.training.networks.whisper import init_encoder

ENCODER_FRAME_SAMPLES = 320
_WHISPER_LAYERS = (1, 3, 5)  # layers of Whisper's encoder, counted from 0
_BLOCK_LENGTH = 50  # for the block network; longer blocks than live cost less
_LOW_BANDS, _HIGH_BANDS = slice(1, 27), slice(27, 69)  # below 1 kHz, and 1 to 5 kHz
_LOUD_PERCENTILE = 95
_TINY_POWER = 1e-7


@dataclass(frozen=True, slots=True)
class TeacherOutputs:
    """The outputs of the teachers for a recording; arrays have the shapes above."""

    whisper: Floats
    phones: Floats
    pitch: Floats
    level: Floats
    effort: Floats


class Teachers:
    """The teachers, ready to run."""

    def __init__(self, blocks: BlockModel, whisper: Path) -> None:
        self._blocks, self._readout = rebuild_encoder(blocks), rebuild_readout(blocks)
        self._whisper = init_encoder(whisper, _WHISPER_LAYERS)
        self._networks = (self._blocks, self._readout, self._whisper)
        self.silence = blocks.inventory.index[blocks.inventory.silence]  # number of the phone
        self._first_state = blocks.topology.first_state
        self.digest = hashlib.sha256(blocks.network.tobytes()).hexdigest()

    @torch.no_grad()
    def compute_targets(self, samples: Int16) -> TeacherOutputs:
        """Compute the targets of samples, (n,) at 16 kHz, up to 20 s."""
        for network in self._networks:
            network.to(DEVICE)
        bands = WhisperMel().accept_waveform(as_floats(samples))
        num_positions = (len(bands) - 1) // 2
        frames = torch.from_numpy(bands[: 2 * num_positions + 1])[None]
        power = 10 ** (4 * bands[: 2 * num_positions].reshape(num_positions, 2, -1) - 4)
        level = np.log10(power.mean(axis=(1, 2)) + _TINY_POWER)
        low, high = (power[..., part].mean(axis=(1, 2)) for part in (_LOW_BANDS, _HIGH_BANDS))
        return TeacherOutputs(
            whisper=self._whisper.features(samples)[:num_positions].astype(np.float32),
            phones=self._phones(frames),
            pitch=track_pitch(samples, num_positions),
            level=(level - np.percentile(level, _LOUD_PERCENTILE)).astype(np.float32),
            effort=np.log10((high + _TINY_POWER) / (low + _TINY_POWER)).astype(np.float32),
        )

    def _phones(self, frames: Tensor) -> Floats:
        """Compute the phones' posteriors: (1, frames, 80) to (positions, phones)."""
        num_positions = (frames.shape[1] - 1) // 2
        missing = -num_positions % _BLOCK_LENGTH  # few sizes: layouts are cached
        padded = pad(frames, (0, 0, 0, 2 * missing), mode="replicate")
        layout = block_layout(num_positions + missing, _BLOCK_LENGTH, device=DEVICE)
        with mixed_precision():
            features = self._blocks(padded.to(DEVICE), layout)
        states = self._readout.read(features.float(), layout)[0, :num_positions].exp().mean(dim=1)
        return np.add.reduceat(states.cpu().numpy(), self._first_state[:-1], axis=1)


def track_pitch(samples: Int16, num_positions: int) -> Floats:
    """Track the pitch; log2 of Hz, NaN without voice, (positions,)."""
    tracker, floats = PitchTracker(), as_floats(samples)
    starts = ENCODER_FRAME_SAMPLES * np.arange(num_positions)
    pitch = [tracker.track(floats[start : start + ENCODER_FRAME_SAMPLES]) for start in starts]
    with np.errstate(divide="ignore"):
        logarithm = np.log2(np.array(pitch, np.float32))
    return np.where(np.isfinite(logarithm), logarithm, np.float32(np.nan))
