"""The same sentence in other voices, by analysis and resynthesis of the sound.

Source: Morise, Yokomori and Ozawa 2016, "WORLD: a vocoder-based high-quality speech synthesis
system": pitch (DIO, StoneMask), spectral envelope (CheapTrick) and aperiodicity (D4C) are taken
apart, changed and put together again. Unlike a warp of log-mel bands this moves the harmonics
apart from the formants, as between a man, a woman and a child.

======== ================================================ ==============
symbol   meaning                                          unit
======== ================================================ ==============
f0       pitch of each frame, 0 where unvoiced            Hz
a        formants are multiplied by this                  1
======== ================================================ ==============

The new pitch is drawn, and the formants follow it as they do over speakers: a pitch ratio of 2
goes with formants about 1.2 times as high (Peterson and Barney 1952, table II).
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyworld
from numpy.typing import NDArray

from services.recognizer.features import SAMPLE_RATE_HZ, LogMel
from training.corpus import Utterance
from training.feature_cache import cached_blocks

_FRAME_MS = 5.0
_LOWEST_F0_HZ, _HIGHEST_F0_HZ = 80.0, 320.0  # of the new voices' medians
_FORMANTS_FOLLOW = 0.25  # log formant ratio per log pitch ratio
_LOWEST_WARP, _HIGHEST_WARP = 0.80, 1.25
_WAY = "voices 1"  # raise when the changes change


@dataclass(frozen=True, slots=True, kw_only=True)
class VoiceChange:
    """One other voice."""

    median_f0_hz: float
    intonation: float  # the pitch's excursions, in octaves, are multiplied by this
    warp_low: float  # formants near 0 Hz are multiplied by this...
    warp_high: float  # ...and those near 8 kHz by this
    breath: float  # exponent of the aperiodicity; below 1 is breathier
    tilt: float  # added to the log spectrum, power, from 0 to 8 kHz

    @classmethod
    def draw(cls, rng: np.random.Generator, median_f0_hz: float) -> VoiceChange:
        """Draw a voice for a recording whose pitch is known (0: nothing is voiced)."""
        low, high = np.log([_LOWEST_F0_HZ, _HIGHEST_F0_HZ])
        target = float(np.exp(rng.uniform(low, high)))
        ratio = target / median_f0_hz if median_f0_hz else 1.0
        log_warp = _FORMANTS_FOLLOW * np.log(ratio) + rng.normal(0.0, 0.05)
        bend = rng.normal(0.0, 0.03)
        warps = np.clip(np.exp([log_warp - bend, log_warp + bend]), _LOWEST_WARP, _HIGHEST_WARP)
        return cls(
            median_f0_hz=target,
            intonation=float(rng.uniform(0.6, 1.3)),
            warp_low=float(warps[0]),
            warp_high=float(warps[1]),
            breath=float(rng.uniform(0.6, 1.5)),
            tilt=float(rng.normal(0.0, 1.0)),
        )


@dataclass(frozen=True, slots=True)
class Voice:
    """A recording taken apart."""

    num_samples: int
    f0_hz: NDArray[np.float64]  # (frames,) 0 where unvoiced
    envelope: NDArray[np.float64]  # (frames, bins) power
    aperiodicity: NDArray[np.float64]  # (frames, bins) 0 to 1

    @classmethod
    def analyse(cls, samples: NDArray[np.float32]) -> Voice:
        """Take a recording apart: shape (n,), 16 kHz, in [-1, 1]."""
        x = np.ascontiguousarray(samples, dtype=np.float64)
        rough, times_s = pyworld.dio(x, SAMPLE_RATE_HZ, frame_period=_FRAME_MS)
        f0_hz = pyworld.stonemask(x, rough, times_s, SAMPLE_RATE_HZ)
        envelope = pyworld.cheaptrick(x, f0_hz, times_s, SAMPLE_RATE_HZ)
        aperiodicity = pyworld.d4c(x, f0_hz, times_s, SAMPLE_RATE_HZ)
        return cls(len(samples), f0_hz, envelope, aperiodicity)

    @property
    def median_f0_hz(self) -> float:
        """Median pitch of the voiced frames; 0 if there are none."""
        voiced = self.f0_hz[self.f0_hz > 0]
        return float(np.median(voiced)) if len(voiced) else 0.0

    def changed(self, change: VoiceChange) -> NDArray[np.float32]:
        """Put the recording together in another voice: as many samples, shape (n,)."""
        f0_hz = self.f0_hz.copy()
        voiced = f0_hz > 0
        if voiced.any():
            excursion = np.log(f0_hz[voiced] / self.median_f0_hz)
            f0_hz[voiced] = change.median_f0_hz * np.exp(change.intonation * excursion)
        num_bins = self.envelope.shape[1]
        bins = np.arange(num_bins)
        warp = np.linspace(change.warp_low, change.warp_high, num_bins)
        at = np.minimum(bins / warp, num_bins - 1)
        low = np.minimum(at.astype(int), num_bins - 2)
        share = at - low
        log_envelope = np.log(self.envelope)
        log_envelope = (1 - share) * log_envelope[:, low] + share * log_envelope[:, low + 1]
        log_envelope += np.linspace(-change.tilt / 2, change.tilt / 2, num_bins)
        aperiodicity = self.aperiodicity[:, np.rint(at).astype(int)] ** change.breath
        sound = pyworld.synthesize(
            f0_hz,
            np.ascontiguousarray(np.exp(log_envelope)),
            np.ascontiguousarray(aperiodicity),
            SAMPLE_RATE_HZ,
            _FRAME_MS,
        )
        out = np.zeros(self.num_samples, dtype=np.float32)
        out[: len(sound)] = np.clip(sound[: self.num_samples], -1.0, 1.0)
        return out


def changed_voices(
    utterances: Sequence[Utterance], *, num_voices: int, seed: int = 0
) -> list[list[NDArray[np.float16]]]:
    """Log-mel features of every utterance in other voices, from the cache or computed.

    Computing takes about 0.04 s per second of sound and another 0.03 s for each voice.

    Parameters
    ----------
    utterances
        Recordings.
    num_voices
        Voices for each.
    seed
        Of the voices; an utterance's voices depend on nothing but this and its name.

    Returns
    -------
    list of list
        ``num_voices`` blocks for each utterance, shape (frames, 41) each with exactly the frames
        of the recording itself, so that its alignment holds for them; empty blocks where the audio
        cannot be read.
    """

    def blocks_of(utterance: Utterance, samples: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        rng = np.random.default_rng([seed, zlib.crc32(utterance.utterance_id.encode())])
        voice = Voice.analyse(samples)
        changes = [VoiceChange.draw(rng, voice.median_f0_hz) for _ in range(num_voices)]
        return [LogMel().accept_waveform(voice.changed(change)) for change in changes]

    blocks = cached_blocks(utterances, f"{_WAY} {num_voices} {seed}", num_voices, blocks_of)
    return [blocks[at : at + num_voices] for at in range(0, len(blocks), num_voices)]
