"""A teacher labels speech that nobody filmed, so that the lips know many voices.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder and its weights); Schuster and Paliwal 1997, "Bidirectional recurrent neural networks"; Xie
et al. 2020, "Self-training with noisy student improves ImageNet classification" (the student hears
noise, the teacher does not).

The teacher hears the whole recording, so it follows a stranger's lips more closely than a live
model can: to what a position knows it adds Whisper's encoder of the clean recording, and its
recurrent layer runs both ways. It learns the clips' lips at `TAUGHT_DELAY_S` in canonical units,
and labels other recordings in the same units.

    z = P clip((concat(h_2, h_4, h_6) - mean) / deviation, -6, 6)

====== =================================================== ==============
symbol meaning                                             shape
====== =================================================== ==============
h_l    Whisper's positions after layer l, one every 20 ms  (512,)
P      projection to principal components of variance 1    (128, 1536)
z      joins the components that the live model knows      (128,)
====== =================================================== ==============
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from scipy.special import expit

from corpora.feature_cache import as_integers, read_audio
from corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from corpora.speech_corpus import audio_files
from services.recognizer.acoustic.neural import NeuralModel
from services.recognizer.lip_positions import POSITION_S
from services.recognizer.lips import LIP_FAPS
from shared.errors import UserError
from shared.face.faps import MOUTH_FAPS
from training.lips.positions import Speech, speech_of
from training.lips.recurrent import Example, train_network
from training.neural.network import Shape
from training.neural.teacher import NUM_LAYERS, WholeEncoder
from training.neural.whisper_weights import load_whisper

Floats = NDArray[np.float32]
Features = NDArray[np.float16]  # of Whisper's encoder
Array = NDArray[np.float64]

_LAYERS = (1, 3, 5)  # of Whisper's encoder, the first is 0
TAUGHT_DELAY_S = 0.015
NUM_RECORDINGS = 100  # drawn from each folder
_MAX_SAMPLES = 20 * SAMPLE_RATE_HZ
_NUM_COMPONENTS = 128
_MAX_DEVIATIONS = 6.0
_MIN_DEVIATION = 1e-3
_STRIDE = 2  # positions, of those that the principal components are of

_NUM_FAPS = len(LIP_FAPS)


@dataclass(frozen=True, slots=True)
class Lessons:
    """What the teacher hears of filmed and of other speech."""

    filmed: Sequence[Features]  # of each stretch that the model is fitted to, (positions, 1536)
    speech: Sequence[Speech]  # stretches that nobody filmed, augmented
    unfilmed: Sequence[Features]  # of each of them


def read_recordings(folders: Sequence[Path], seed: int) -> list[LipClip]:
    """Draw recordings of speech without lips, as many from each folder.

    Raises
    ------
    UserError
        If a folder holds no recordings, or one of them cannot be read.
    """
    rng = np.random.default_rng(seed)
    recordings = []
    for folder in folders:
        files = audio_files(folder)
        for number in rng.permutation(len(files))[:NUM_RECORDINGS]:
            try:
                samples = read_audio(files[number])[:_MAX_SAMPLES]
            except ValueError as error:
                raise UserError(f"{error}; remove it, or give another folder") from error
            recordings.append(_without_lips(files[number], samples))
    return recordings


def _without_lips(path: Path, samples: Floats) -> LipClip:
    return LipClip(
        name=path.name,
        speaker="",
        licence="",
        language="",
        part="train",
        is_in_sync=True,
        transcript="",
        time_s=np.empty(0),
        faps=np.empty((0, len(MOUTH_FAPS))),
        samples=samples,
    )


def load_encoder(whisper: Path) -> WholeEncoder:
    """Load Whisper's encoder from the folder of Whisper base.

    Raises
    ------
    UserError
        If it cannot be read.
    """
    encoder = WholeEncoder(Shape(num_states=0, look_aheads=(), layers=NUM_LAYERS), _LAYERS)
    load_whisper(encoder, whisper)
    return encoder.eval()


def hear(
    encoder: WholeEncoder,
    model: NeuralModel,
    filmed: Sequence[Speech],
    recordings: Sequence[LipClip],
) -> Lessons:
    """Let the teacher hear the filmed speech and recordings; the latter are augmented too."""
    clips = {each.clip.name: each.clip for each in filmed}
    whole = {
        name: encoder.features(as_integers(clip.samples))
        for name, clip in track(clips.items(), description="clips for the teacher")
    }
    speech, unfilmed = [], []
    for recording in track(recordings, description="recordings"):
        if stretches := speech_of(model, recording, copy=1):
            features = encoder.features(as_integers(recording.samples))
            speech += stretches
            unfilmed += [_at_positions(features, stretch) for stretch in stretches]
    return Lessons(
        [_at_positions(whole[each.clip.name], each) for each in filmed], speech, unfilmed
    )


def _at_positions(features: Features, speech: Speech) -> Features:
    """Return Whisper's features of the mouth that is taught at each position of a stretch."""
    time_s = (speech.known_s - TAUGHT_DELAY_S) * speech.speed
    places = np.rint(time_s / POSITION_S).astype(np.int64) - 1  # the first stands at 20 ms
    return features[np.clip(places, 0, len(features) - 1)]


def teach(
    lessons: Lessons,
    examples: Sequence[Example],
    components: Sequence[Floats],
    delays_s: Sequence[float],
    *,
    num_epochs: int,
    seed: int,
) -> list[Example]:
    """Train a teacher and let it label.

    Parameters
    ----------
    lessons
        What it hears.
    examples
        The filmed stretches, from speakers 0, 1, ... on; `TAUGHT_DELAY_S` is one of the delays.
    components
        Of each stretch that nobody filmed, (positions, components).
    delays_s
        Delays of the examples' targets, seconds.

    Returns
    -------
    list
        The stretches that nobody filmed, with labels. They are one further speaker.
    """
    mean, deviation, projection = _principal_components(np.concatenate(list(lessons.filmed)))

    def inputs(features: Features, known: Floats) -> Floats:
        standard = _standard(features, mean, deviation)
        return np.concatenate([standard @ projection, known], axis=1)

    taught = delays_s.index(TAUGHT_DELAY_S)
    network, _ = train_network(
        [
            replace(
                example,
                components=inputs(features, example.components),
                targets=example.targets[:, taught : taught + 1],
            )
            for features, example in zip(lessons.filmed, examples, strict=True)
        ],
        num_epochs=num_epochs,
        seed=seed,
        both_ways=True,
    )
    speaker = 1 + max(example.speaker for example in examples)
    labelled = []
    for features, known, speech in zip(lessons.unfilmed, components, lessons.speech, strict=True):
        with torch.no_grad():
            outputs = network(torch.from_numpy(inputs(features, known))[None])[0, :, 0].numpy()
        outputs[:, _NUM_FAPS:] = expit(outputs[:, _NUM_FAPS:])
        labelled.append(Example(known, _delayed(outputs, speech.known_s, delays_s), speaker))
    return labelled


def _principal_components(features: Features) -> tuple[Floats, Floats, Floats]:
    """Return mean, deviation and projection of features, (n, 1536)."""
    some = features[::_STRIDE].astype(np.float32)
    mean, deviation = some.mean(axis=0), some.std(axis=0) + _MIN_DEVIATION
    standard = _standard(some, mean, deviation)
    variances, directions = np.linalg.eigh(standard.T @ standard / len(standard))
    first = slice(-1, -1 - _NUM_COMPONENTS, -1)
    scaled = directions[:, first] / np.sqrt(np.maximum(variances[first], _MIN_DEVIATION))
    return mean, deviation, scaled


def _standard(features: NDArray[np.floating], mean: Floats, deviation: Floats) -> Floats:
    standard: Floats = (features.astype(np.float32) - mean) / deviation
    return standard.clip(-_MAX_DEVIATIONS, _MAX_DEVIATIONS)


def _delayed(labels: Floats, known_s: Array, delays_s: Sequence[float]) -> Floats:
    """Labels of each delay, (positions, delays, 17), from those of one, (positions, 17).

    They are unknown (NaN) where the mouth moved before or after the stretch.
    """
    time_s = known_s - TAUGHT_DELAY_S
    wanted_s = known_s[:, None] - np.asarray(delays_s)
    tracks = [np.interp(wanted_s, time_s, track, np.nan, np.nan) for track in labels.T]
    return np.stack(tracks, axis=-1).astype(np.float32)
