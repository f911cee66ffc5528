"""The lip teacher predicts the lips of a speaker from the whole recording.

It learns from filmed speech. Its inputs come from networks that process the whole clean recording,
and its recurrent layer runs both ways. It therefore follows unseen speakers more closely than a
live network can. It labels speech without video, so that the audio encoder learns lips from many
voices.

    z = P clip((h - mean) / deviation, -6, 6)
    q = log(phones + 0.001) / 3 + 1

====== ============================================================== ==================
symbol meaning                                                        shape
====== ============================================================== ==================
h      positions of Whisper's encoder after three layers, one every   (positions, 1536)
       20 ms
P      projection to principal components of variance 1               (1536, 128)
phones posteriors of the phones, of the block network                 (positions, phones)
z, q   inputs                                                         (positions, ...)
====== ============================================================== ==================

Sources: Schuster and Paliwal 1997, "Bidirectional recurrent neural networks"; Xie et al. 2020,
"Self-training with noisy student improves ImageNet classification" (only the student's input is
noisy).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.special import expit

from kouxing.corpora.lip_clips import LipClip
from kouxing.corpora.parallel import process_in_order
from kouxing.services.mouth_profiles.lip_inputs import ENCODER_FRAME_S
from kouxing.services.recognizer.front_end.features import WINDOW_SAMPLES
from kouxing.services.recognizer.lips.lip_predictor import NUM_LIP_FAPS
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.files.output_file import open_output
from kouxing.shared.phones.events import Phone
from kouxing.training.encoder.teachers import Teachers
from kouxing.training.lips.recipe import measure_scale, repeats_by_source, standardize
from kouxing.training.lips.recurrent import LipNetwork, SpeechExample, train_network
from kouxing.training.lips.targets import closed_below, targets_at
from kouxing.training.seed import SEED

NUM_EPOCHS = 12
_NUM_COMPONENTS = 128
_MAX_DEVIATIONS = 6.0
_MIN_DEVIATION = 1e-3
_STRIDE = 2  # every second position is used for the principal components
_PART_SAMPLES, _MIN_SAMPLES = 320_000, 8000  # limits for a recording
_NUM_NETWORKS = 4
_PARTS = ("mean", "deviation", "directions")


@dataclass(frozen=True, slots=True)
class TeacherFeatures:
    """Outputs of the networks for a recording; row p is centered on 20 (p + 1) ms."""

    whisper: Floats  # (positions, 1536)
    phones: Floats  # (positions, phones)


@dataclass(frozen=True, slots=True)
class Projection:
    """Projection of Whisper's positions to principal components of variance 1."""

    mean: Floats  # (features,)
    deviation: Floats  # (features,)
    directions: Floats  # (features, components)

    @classmethod
    def fit(cls, positions: Floats) -> Projection:
        """Fit it to positions, (n, features)."""
        sampled = positions[::_STRIDE]
        mean, deviation = sampled.mean(axis=0), sampled.std(axis=0) + _MIN_DEVIATION
        standard = _standard(sampled, mean, deviation)
        variances, directions = np.linalg.eigh(standard.T @ standard / len(standard))
        first = slice(-1, -1 - _NUM_COMPONENTS, -1)
        scale = np.sqrt(np.maximum(variances[first], _MIN_DEVIATION))
        return cls(mean, deviation, directions[:, first] / scale)

    def apply(self, positions: Floats) -> Floats:
        """Project positions, (n, features) to (n, components)."""
        return _standard(positions, self.mean, self.deviation) @ self.directions


def _standard(positions: Floats, mean: Floats, deviation: Floats) -> Floats:
    standard: Floats = (positions - mean) / deviation
    return standard.clip(-_MAX_DEVIATIONS, _MAX_DEVIATIONS)


@dataclass(frozen=True, slots=True)
class LipTeacher:
    """Trained networks, whose mean output counts."""

    projection: Projection
    networks: Sequence[LipNetwork]

    @torch.no_grad()
    def predict_lips(self, features: TeacherFeatures) -> Floats:
        """Predict FAPs in canonical units, closure and lip to teeth: (positions, 17)."""
        inputs = torch.from_numpy(_inputs(self.projection, features))
        outputs = torch.stack([network(inputs[None])[0, :, 0] for network in self.networks])
        lips: Floats = outputs.mean(dim=0).numpy()
        lips[:, NUM_LIP_FAPS:] = expit(lips[:, NUM_LIP_FAPS:])
        return lips

    def save(self, path: Path) -> None:
        """Write the teacher."""
        projection = {name: torch.from_numpy(getattr(self.projection, name)) for name in _PARTS}
        networks = [network.state_dict() for network in self.networks]
        with open_output(path) as file:
            torch.save({"projection": projection, "networks": networks}, file)

    @classmethod
    def load(cls, path: Path) -> LipTeacher:
        """Read a file of :meth:`save`."""
        state = torch.load(path, weights_only=True)
        networks = []
        for weights in state["networks"]:
            sizes = weights["entry.weight"].shape[1], 1, len(weights["offset"])
            networks.append(LipNetwork(*sizes, both_ways=True).eval())
            networks[-1].load_state_dict(weights)
        return cls(Projection(*(state["projection"][name].numpy() for name in _PARTS)), networks)


def teacher_features(teachers: Teachers, samples: Floats) -> TeacherFeatures:
    """Run the networks on a whole recording at 16 kHz."""
    features = []
    for start in range(0, max(1, len(samples) - _MIN_SAMPLES), _PART_SAMPLES):
        part = samples[start : start + _PART_SAMPLES + WINDOW_SAMPLES]
        outputs = teachers.compute_targets(as_integers(part))
        features.append((outputs.whisper, outputs.phones))
    whisper, phones = zip(*features, strict=True)
    return TeacherFeatures(np.concatenate(whisper), np.concatenate(phones))


def train_lip_teacher(
    clips: Sequence[LipClip],
    features: Sequence[TeacherFeatures],
    phones: Mapping[str, Sequence[Phone]],
) -> LipTeacher:
    """Train the teacher on filmed clips; ``phones`` has phones by clip name."""
    projection = Projection.fit(
        np.concatenate([clip_features.whisper for clip_features in features])
    )
    closed_at = closed_below(clips)
    targets = []
    for clip, clip_features in zip(clips, features, strict=True):
        time_s = ENCODER_FRAME_S * np.arange(1.0, 1 + len(clip_features.whisper))
        known = phones.get(clip.name)
        targets.append(targets_at(clip, known, closed_at[clip.speaker], time_s, [0.0]))
    units = measure_scale(targets)
    speakers = sorted({clip.speaker for clip in clips})
    repeats = repeats_by_source(clips)
    examples = []
    for clip, clip_features, target in zip(clips, features, targets, strict=True):
        rows = _inputs(projection, clip_features), standardize(target, units)
        example = SpeechExample(*rows, speakers.index(clip.speaker))
        examples += repeats[clip.source] * [example]

    def train(number: int) -> LipNetwork:
        network, _ = train_network(
            examples, num_epochs=NUM_EPOCHS, seed=SEED + number, both_ways=True
        )
        return network

    return LipTeacher(projection, list(process_in_order(train, range(_NUM_NETWORKS))))


def _inputs(projection: Projection, features: TeacherFeatures) -> Floats:
    phones = np.log(features.phones + 1e-3) / 3 + 1
    return np.concatenate([projection.apply(features.whisper), phones], axis=1).astype(np.float32)
