"""The teacher labels speech without video, so that the lip model learns from many voices.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder and its weights); Schuster and Paliwal 1997, "Bidirectional recurrent neural networks"; Xie
et al. 2020, "Self-training with noisy student improves ImageNet classification" (only the student's
input is noisy).

The teacher sees the whole recording, so it follows an unseen speaker more closely than a live model
can. Its inputs are Whisper's encoder of the clean recording and the live model's components. Its
recurrent layer runs both ways. It learns the clips' lips at `TAUGHT_DELAY_S` in canonical units,
and labels other recordings in the same units. Only the live model's components and the labels are
kept, 0.1 GB for an hour of speech.

    z = P clip((concat(h_2, h_4, h_6) - mean) / deviation, -6, 6)

====== =================================================== ==============
symbol meaning                                             shape
====== =================================================== ==============
h_l    Whisper's positions after layer l, one every 20 ms  (512,)
P      projection to principal components of variance 1    (128, 1536)
z      joins the components of the live model              (128,)
====== =================================================== ==============
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from scipy.special import expit

from kouxing.corpora.feature_cache import as_floats, as_integers
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lip_predictor import LIP_FAPS
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.training.lips.positions import Speech, speech_of
from kouxing.training.lips.recurrent import Example, LipNetwork, train_network
from kouxing.training.neural.initial_network import load_whisper
from kouxing.training.neural.network import Shape
from kouxing.training.neural.teacher import NUM_LAYERS, WholeEncoder
from kouxing.training.training_set import load_untranscribed

Floats = NDArray[np.float32]
Features = NDArray[np.float16]  # of Whisper's encoder
Array = NDArray[np.float64]

_LAYERS = (1, 3, 5)  # of Whisper's encoder, the first is 0
TAUGHT_DELAY_S = 0.015
_MAX_FOLDER_S = 3600.0  # drawn from each folder, so that none outweighs the others
_NUM_COMPONENTS = 128
_MAX_DEVIATIONS = 6.0
_MIN_DEVIATION = 1e-3
_STRIDE = 2  # every second position is used for the principal components

_NUM_FAPS = len(LIP_FAPS)

T = TypeVar("T", bound=np.generic)


def draw_recordings(folders: Sequence[Path], seed: int) -> list[LipClip]:
    """Draw clips without lips, at most an hour from each folder.

    They are pieces of up to 20 s. Recordings that models are measured on are left out. Raises
    UserError if a folder contains no usable recordings.
    """
    rng = np.random.default_rng(seed)
    drawn = []
    for folder in folders:
        pieces = load_untranscribed([folder], RowErrors())
        total_s = 0.0
        for number in rng.permutation(len(pieces)):
            if total_s >= _MAX_FOLDER_S:
                break
            total_s += len(pieces[number]) / SAMPLE_RATE_HZ
            drawn.append(
                LipClip(
                    name=f"{folder.name} {number}",
                    time_s=np.empty(0),
                    faps=np.empty((0, len(MOUTH_FAPS))),
                    samples=as_floats(pieces[number]),
                )
            )
    return drawn


def load_encoder(whisper: Path) -> WholeEncoder:
    """Load Whisper's encoder from the folder of Whisper base; UserError if it cannot be read."""
    encoder = WholeEncoder(Shape(num_states=0, look_aheads=(), layers=NUM_LAYERS), _LAYERS)
    load_whisper(encoder, whisper)
    return encoder.eval()


@dataclass(frozen=True, slots=True)
class Projection:
    """Projection of the encoder's features to principal components of variance 1."""

    mean: Floats  # (features,)
    deviation: Floats  # (features,)
    directions: Floats  # (features, components)

    @classmethod
    def of(cls, features: Features) -> Projection:
        """Fit it to features, (n, features)."""
        some = features[::_STRIDE].astype(np.float32)
        mean, deviation = some.mean(axis=0), some.std(axis=0) + _MIN_DEVIATION
        standard = _standardize(some, mean, deviation)
        variances, directions = np.linalg.eigh(standard.T @ standard / len(standard))
        first = slice(-1, -1 - _NUM_COMPONENTS, -1)
        scale = np.sqrt(np.maximum(variances[first], _MIN_DEVIATION))
        return cls(mean, deviation, directions[:, first] / scale)

    def apply(self, features: Features) -> Floats:
        """Project features, (n, features) to (n, components)."""
        return _standardize(features, self.mean, self.deviation) @ self.directions


def _standardize(features: NDArray[np.floating], mean: Floats, deviation: Floats) -> Floats:
    standard: Floats = (features.astype(np.float32) - mean) / deviation
    return standard.clip(-_MAX_DEVIATIONS, _MAX_DEVIATIONS)


@dataclass(frozen=True, slots=True)
class Teacher:
    """Predicts lips from Whisper's encoder and the live model's components."""

    encoder: WholeEncoder
    projection: Projection
    network: LipNetwork

    @torch.no_grad()
    def label(
        self,
        speech: Sequence[Speech],
        components: Sequence[Floats],
        delays_s: Sequence[float],
        speaker: int,
    ) -> list[Example]:
        """Label the stretches of a recording's augmented copy.

        ``components`` are the live model's components of each stretch, (positions, components). The
        examples get this ``speaker`` number, and labels of these delays.
        """
        if not speech:
            return []
        whole = self.projection.apply(_features_of(self.encoder, speech[0].clip))
        examples = []
        for stretch, known in zip(speech, components, strict=True):
            inputs = np.concatenate([_at_positions(whole, stretch), known], axis=1)
            outputs = self.network(torch.from_numpy(inputs)[None])[0, :, 0].numpy()
            outputs[:, _NUM_FAPS:] = expit(outputs[:, _NUM_FAPS:])
            labels = _delayed(outputs, stretch.known_s, delays_s)
            examples.append(Example(known.astype(np.float16), labels, speaker))
        return examples


def train_teacher(
    encoder: WholeEncoder,
    speech: Sequence[Speech],
    examples: Sequence[Example],
    delays_s: Sequence[float],
    *,
    num_epochs: int,
    seed: int,
) -> Teacher:
    """Train a teacher on filmed speech.

    ``speech`` are stretches of clips and of their augmented copies, with an example for each. The
    teacher's input is always the clean clip. `TAUGHT_DELAY_S` must be one of ``delays_s``, the
    delays of the examples' targets.
    """
    clips = {stretch.clip.name: stretch.clip for stretch in speech}
    whole = {
        name: _features_of(encoder, clip)
        for name, clip in track(clips.items(), description="clips for the teacher")
    }
    features_of_stretches = [_at_positions(whole[one.clip.name], one) for one in speech]
    projection = Projection.of(np.concatenate(features_of_stretches))
    taught = delays_s.index(TAUGHT_DELAY_S)
    network, _ = train_network(
        [
            replace(
                example,
                components=np.concatenate([projection.apply(features), example.components], axis=1),
                targets=example.targets[:, taught : taught + 1],
            )
            for features, example in zip(features_of_stretches, examples, strict=True)
        ],
        num_epochs=num_epochs,
        seed=seed,
        both_ways=True,
    )
    return Teacher(encoder, projection, network)


def label_recordings(
    teacher: Teacher,
    model: NeuralModel,
    recordings: Sequence[LipClip],
    components: Callable[[Speech], Floats],
    delays_s: Sequence[float],
    speaker: int,
) -> list[Example]:
    """Label recordings; the components of the examples come from augmented copies.

    ``components`` computes the live model's components of a stretch, (positions, components). The
    examples get this ``speaker`` number, and labels of these delays.
    """
    augmented = speech_of(model, recordings, copy=1)
    return [
        example
        for speech in track(augmented, description="recordings", total=len(recordings))
        for example in teacher.label(
            speech, [components(stretch) for stretch in speech], delays_s, speaker
        )
    ]


def _features_of(encoder: WholeEncoder, clip: LipClip) -> Features:
    return encoder.features(as_integers(clip.samples))


def _at_positions(whole: NDArray[T], speech: Speech) -> NDArray[T]:
    """Select the rows of a recording, one every 20 ms, for the positions of a stretch."""
    time_s = (speech.known_s - TAUGHT_DELAY_S) * speech.speed
    places = np.rint(time_s / POSITION_S).astype(np.int64) - 1  # the first row is at 20 ms
    return whole[np.clip(places, 0, len(whole) - 1)]


def _delayed(labels: Floats, known_s: Array, delays_s: Sequence[float]) -> NDArray[np.float16]:
    """Shift labels, (positions, 17), to each delay, (positions, delays, 17).

    They are NaN for times before or after the stretch.
    """
    time_s = known_s - TAUGHT_DELAY_S
    wanted_s = known_s[:, None] - np.asarray(delays_s)
    tracks = [np.interp(wanted_s, time_s, track, np.nan, np.nan) for track in labels.T]
    return np.stack(tracks, axis=-1).astype(np.float16)
