"""What the acoustic network computes at every position of a recording, as in the product.

Augmented copies of a clip have other speeds, rooms, noises, lines and levels; their lips move at
the same speed.

Positions are kept in the cache folder, 16 bits a number: 2.4 KB for each 20 ms of speech.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corpora.feature_cache import cache_folder
from corpora.lip_clips import LipClip
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.lip_positions import lip_positions
from training.neural.augmentation import augment_samples, scale_level

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_FORMAT = "3"  # raise when the positions change


@dataclass(frozen=True, slots=True, kw_only=True)
class Speech:
    """A stretch of speech of a clip or of its augmented copy."""

    clip: LipClip
    features: NDArray[np.float16]  # (positions, features) as `LipModel` takes them
    known_s: Array  # (positions,) media time up to which the sound is known
    speed: float  # of the copy; above 1 is faster than the clip


def speech_of(model: NeuralModel, clip: LipClip, copy: int = 0) -> list[Speech]:
    """Return the speech of a clip (copy 0), or of one of its augmented copies, always the same."""
    samples, speed = clip.samples, 1.0
    if copy:
        rng = np.random.default_rng([copy, zlib.crc32(clip.name.encode())])
        samples, speed = augment_samples(samples, rng)
        samples = scale_level(samples, rng)
    positions = _positions(model, samples)
    parts = (np.split(positions[name], positions["starts"]) for name in ("features", "known_s"))
    return [
        Speech(clip=clip, features=features, known_s=known_s, speed=speed)
        for features, known_s in zip(*parts, strict=True)
        if len(known_s)
    ]


def _positions(model: NeuralModel, samples: Floats) -> dict[str, NDArray[Any]]:
    """Features and times of all positions and the first of each stretch, cached or computed."""
    key = hashlib.sha256(_FORMAT.encode())
    key.update(model.network.tobytes())
    key.update(samples.tobytes())
    path = cache_folder() / f"lip_positions_{key.hexdigest()[:20]}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as kept:
            return dict(kept)
    recorded = lip_positions(model, samples)
    num_positions = len(recorded.known_s)
    positions: dict[str, NDArray[Any]] = {
        "starts": np.array(recorded.starts, dtype=np.int64),
        "known_s": np.array(recorded.known_s, dtype=np.float64),
        "features": np.array(recorded.features, dtype=np.float16).reshape(num_positions, -1),
    }
    np.savez(path, allow_pickle=False, **positions)
    return positions


def features_of(speech: Sequence[Speech]) -> Floats:
    """Return the features of all positions in one array, (positions, features)."""
    return np.concatenate([each.features for each in speech]).astype(np.float32)


def components_of(speech: Speech, mean: Floats, projection: Floats) -> Floats:
    """Return the principal components of a stretch of speech, (positions, components)."""
    centred = speech.features.astype(np.float32) - mean
    return (centred @ projection).astype(np.float32, copy=False)
