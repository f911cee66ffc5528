"""The inputs of the lip model at every position of a recording, as in the product.

Augmented copies of a clip have other speeds, rooms, noises, lines and levels. The lips move at the
same speed as the audio. Positions are cached on disk, 0.8 KB for each 20 ms of speech.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.feature_cache import cache_folder, load_or_compute
from kouxing.corpora.lip_clips import LipClip
from kouxing.services.mouth_profiles.lip_inputs import record_lip_inputs
from kouxing.services.recognizer.acoustic.encoder import ENCODER_PATH
from kouxing.shared.arrays import Doubles, Float16, Floats
from kouxing.training.networks.augmentation import augment_samples, scale_level

_FORMAT = "4"  # raise when the positions change


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeechStretch:
    """A stretch of speech of a clip or of its augmented copy."""

    clip: LipClip
    features: Float16  # (positions, features), inputs of the lip model
    known_s: Doubles  # (positions,) media time up to which the audio is known
    speed: float  # speed of the copy; above 1 is faster than the clip


def speech_of(clips: Sequence[LipClip], copy: int = 0) -> Iterator[SpeechStretch]:
    """Yield the speech of each clip (copy 0) or of one of its augmented copies.

    A copy is always augmented in the same way.
    """
    encoder_hash = hashlib.sha256(_FORMAT.encode())
    encoder_hash.update(ENCODER_PATH.read_bytes())
    for clip in track(clips, "augmented copies" if copy else "clips"):
        samples, speed = _sound_of(clip, copy)
        positions = _positions(encoder_hash, samples)
        parts = [np.split(positions[name], positions["starts"]) for name in ("features", "known_s")]
        for features, known_s in zip(*parts, strict=True):
            if len(known_s):
                yield SpeechStretch(clip=clip, features=features, known_s=known_s, speed=speed)


def _sound_of(clip: LipClip, copy: int) -> tuple[Floats, float]:
    if not copy:
        return clip.samples, 1.0
    rng = np.random.default_rng([copy, zlib.crc32(clip.name.encode())])
    samples, speed = augment_samples(clip.samples, rng)
    return scale_level(samples, rng), speed


def _positions(encoder_hash: hashlib._Hash, samples: Floats) -> dict[str, NDArray[Any]]:
    key = encoder_hash.copy()
    key.update(samples.tobytes())

    def compute() -> dict[str, NDArray[Any]]:
        recorded = record_lip_inputs(samples)
        return {
            "starts": np.array(recorded.starts, dtype=np.int64),
            "known_s": np.array(recorded.known_s, dtype=np.float64),
            "features": np.array(recorded.features, dtype=np.float16),
        }

    return load_or_compute(cache_folder() / f"lip_positions_{key.hexdigest()[:20]}.npz", compute)


def features_of(speech: Sequence[SpeechStretch]) -> Floats:
    """Return the features of all positions in one array, (positions, features)."""
    return np.concatenate([stretch.features for stretch in speech]).astype(np.float32)


def components_of(speech: SpeechStretch, mean: Floats, projection: Floats) -> Floats:
    """Return the principal components of a stretch of speech, (positions, components)."""
    centered = speech.features.astype(np.float32) - mean
    return (centered @ projection).astype(np.float32, copy=False)
