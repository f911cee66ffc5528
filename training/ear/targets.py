"""Recordings with the targets of the small ear, computed once and kept on disk.

The recordings are shuffled, so that the first ones are representative. They are split into chunks.
The chunks are computed one after the other during training. Each target file has these columns:

========= ===================================================================== ========
columns   meaning (:mod:`kouxing.training.ear.teachers`)                        number
========= ===================================================================== ========
pitch     log2 of Hz, NaN without voice                                         1
level     relative to the recording                                             1
effort    balance of high and low frequencies                                   1
voice     number of a :class:`Voice`                                            1
phones    posteriors                                                            phones
causal    principal components of the causal network's values                   128
encoder   principal components of Whisper's encoder                             128
lips      outputs of the lip predictor, standardized                            51
========= ===================================================================== ========

A principal component is divided by the square root of its standard deviation, so that later
components have less weight. Some recordings also have a sung or held copy.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import as_floats, as_integers
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.lip_predictor import NUM_OUTPUTS
from kouxing.shared.errors import UserError
from kouxing.training.ear.singing import sing
from kouxing.training.ear.teachers import (
    LIP_DELAYS_S,
    POSITION_SAMPLES,
    TeacherOutputs,
    Teachers,
)

Floats = NDArray[np.float32]
Samples = NDArray[np.int16]  # 16 kHz

PITCH, LEVEL, EFFORT, VOICE = range(4)  # columns
NUM_COMPONENTS = 128
NUM_LIPS = len(LIP_DELAYS_S) * NUM_OUTPUTS
CHUNK_SIZE = 64  # recordings
_NUM_FITTED = 192  # recordings that the principal components are computed from
_SUNG_PROB = 0.25
_MAX_SUNG_SAMPLES = 64_000  # of the speech
_MIN_SAMPLES, _MAX_SAMPLES = 8000, 320_000
_SILENT = 0.5  # posterior of silence above which a position is not speech
_LAUGHING_LEVEL = -2.0  # level above which laughter is audible
_MIN_VARIANCE = 1e-6


class Voice(IntEnum):
    """Kinds of voice."""

    NONE = 0
    SPEECH = 1
    SUNG = 2  # or held
    LAUGHTER = 3


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording to train on."""

    name: str
    read: Callable[[], Samples]  # ValueError if it cannot be read
    weight: float  # relative sampling frequency
    voice: Voice = Voice.SPEECH  # where it is audible


@dataclass(frozen=True, slots=True)
class Piece:
    """A recording, or a part of one, with its targets."""

    samples: Samples  # (320 positions,)
    targets: NDArray[np.float16]  # (positions, columns)
    weight: float


@dataclass(frozen=True, slots=True)
class Columns:
    """The target columns that are ranges."""

    num_phones: int

    @property
    def phones(self) -> slice:
        """Posteriors of the phones."""
        return slice(VOICE + 1, VOICE + 1 + self.num_phones)

    @property
    def causal(self) -> slice:
        """Components of the causal network."""
        return slice(self.phones.stop, self.phones.stop + NUM_COMPONENTS)

    @property
    def encoder(self) -> slice:
        """Components of Whisper's encoder."""
        return slice(self.causal.stop, self.causal.stop + NUM_COMPONENTS)

    @property
    def lips(self) -> slice:
        """Outputs of the lip predictor."""
        return slice(self.encoder.stop, self.encoder.stop + NUM_LIPS)


class TargetStore:
    """The chunks in a folder."""

    def __init__(
        self,
        folder: Path,
        recordings: Sequence[Recording],
        teachers: Teachers,
        errors: RowErrors,
        seed: int,
    ) -> None:
        """Open a folder; UserError if it has targets of other recordings, or no usable recording.

        ``errors`` receives a message for every recording that cannot be read.
        """
        self._folder, self._teachers, self._errors, self._seed = folder, teachers, errors, seed
        rng = np.random.default_rng(seed)
        order = rng.exponential(size=len(recordings)) / [one.weight for one in recordings]
        self._recordings = [recordings[number] for number in np.argsort(order)]
        self.num_chunks = -(-len(recordings) // CHUNK_SIZE)
        folder.mkdir(parents=True, exist_ok=True)
        self._check_key()
        self._basis = self._load_basis()
        self._pieces: list[Piece] = []
        self._num_loaded = 0

    def pieces(self, num_chunks: int) -> list[Piece]:
        """Return the pieces of the first chunks; compute those that are missing."""
        while self._num_loaded < min(num_chunks, self.num_chunks):
            self._pieces += self._chunk(self._num_loaded)
            self._num_loaded += 1
        return self._pieces

    def _check_key(self) -> None:
        key = hashlib.sha256(f"2 {self._seed} {self._teachers.digest}".encode())
        for recording in self._recordings:
            key.update(f"{recording.name} {recording.voice}\n".encode())
        path = self._folder / "key"
        if not path.exists():
            path.write_text(key.hexdigest())
        elif path.read_text() != key.hexdigest():
            raise UserError(
                f"{self._folder} contains targets of other recordings or models; delete it"
            )

    def _load_basis(self) -> dict[str, Floats]:
        """Load the bases of components and lips, or compute them from the first recordings."""
        path = self._folder / "basis.npz"
        if not path.exists():
            speech = [one for one in self._recordings if one.voice == Voice.SPEECH][:_NUM_FITTED]
            sounds = [sound for one in speech for sound in self._cut(one)]
            if not sounds:
                raise self._errors.no_recording_error("among the first ones")
            all_outputs = [self._teachers.compute_targets(sound) for sound in sounds]
            basis = {}
            for name in ("causal", "encoder"):
                values = np.concatenate([getattr(outputs, name) for outputs in all_outputs])
                basis[f"{name}_mean"] = values.mean(axis=0)
                basis[name] = _components_of(values - basis[f"{name}_mean"])
            lips = np.concatenate([outputs.lips for outputs in all_outputs])
            basis |= {"lips_mean": lips.mean(axis=0), "lips_deviation": lips.std(axis=0)}
            np.savez(path.with_suffix(".part.npz"), allow_pickle=False, **basis)
            path.with_suffix(".part.npz").replace(path)
        with np.load(path, allow_pickle=False) as file:
            return dict(file)

    def _chunk(self, number: int) -> list[Piece]:
        samples, targets, ends = (
            self._folder / f"{number:04}.{name}.npy" for name in ("samples", "targets", "ends")
        )
        if not ends.exists():
            pieces = self._compute(number)
            rows = [(len(piece.targets), piece.weight) for piece in pieces]
            if pieces:
                np.save(samples, np.concatenate([piece.samples for piece in pieces]))
                np.save(targets, np.concatenate([piece.targets for piece in pieces]))
            np.save(unfinished := ends.with_suffix(".part.npy"), np.array(rows).reshape(-1, 2))
            unfinished.replace(ends)  # it marks the chunk as complete
        lengths, weights = np.load(ends).T
        if not len(lengths):
            return []
        bounds = np.cumsum(lengths[:-1]).astype(np.int64)
        sounds = np.split(np.load(samples, mmap_mode="r"), POSITION_SAMPLES * bounds)
        rows_of = np.split(np.load(targets, mmap_mode="r"), bounds)
        return [Piece(*one) for one in zip(sounds, rows_of, weights.tolist(), strict=True)]

    def _compute(self, number: int) -> list[Piece]:
        rng = np.random.default_rng([self._seed, number])
        pieces = []
        for recording in self._recordings[CHUNK_SIZE * number :][:CHUNK_SIZE]:
            for piece in self.pieces_of(recording):
                pieces.append(piece)
                if recording.voice == Voice.SPEECH and rng.random() < _SUNG_PROB:
                    pieces += _sung_copy(piece, rng)
        return pieces

    def pieces_of(self, recording: Recording) -> list[Piece]:
        """Compute the targets of a recording."""
        pieces = []
        for samples in self._cut(recording):
            outputs = self._teachers.compute_targets(samples)
            voice = np.full(len(outputs.level), recording.voice, np.float32)
            voice[~self._is_audible(outputs, recording.voice)] = Voice.NONE
            scalars = [outputs.pitch, outputs.level, outputs.effort, voice]
            components = [self._project(outputs, name) for name in ("causal", "encoder")]
            lips = (outputs.lips - self._basis["lips_mean"]) / self._basis["lips_deviation"]
            rows = [*scalars, outputs.phones, *components, lips]
            targets = np.column_stack(rows).astype(np.float16)
            kept = samples[: POSITION_SAMPLES * len(targets)]
            pieces.append(Piece(kept, targets, recording.weight))
        return pieces

    def _cut(self, recording: Recording) -> list[Samples]:
        """Read a recording in parts of up to 20 s; return an empty list if it cannot be read."""
        try:
            samples = recording.read()
        except ValueError as error:
            self._errors.add(recording.name, str(error))
            return []
        starts = range(0, max(1, len(samples) - _MIN_SAMPLES), _MAX_SAMPLES)
        parts = [samples[start : start + _MAX_SAMPLES] for start in starts]
        return [part for part in parts if len(part) >= _MIN_SAMPLES]

    def _project(self, outputs: TeacherOutputs, name: str) -> Floats:
        """Compute the components of a teacher's values, (positions, 128)."""
        centered = getattr(outputs, name) - self._basis[f"{name}_mean"]
        return np.asarray(centered @ self._basis[name], np.float32)

    def _is_audible(self, outputs: TeacherOutputs, voice: Voice) -> NDArray[np.bool_]:
        if voice == Voice.SPEECH:
            return np.asarray(outputs.phones[:, self._teachers.silence] < _SILENT)
        return np.asarray(outputs.level > _LAUGHING_LEVEL)


def _components_of(centered: Floats) -> Floats:
    """Find the first principal directions of rows, (n, features), with their scales."""
    variances, directions = np.linalg.eigh(centered.T @ centered / len(centered))
    first = slice(-1, -1 - NUM_COMPONENTS, -1)
    deviation = np.sqrt(np.maximum(variances[first], _MIN_VARIANCE))
    scale = 1 / np.sqrt(deviation)
    scale /= np.sqrt(np.mean(deviation))  # so that the mean variance is 1
    components: Floats = (directions[:, first] * scale).astype(np.float32)
    return components


def _sung_copy(piece: Piece, rng: np.random.Generator) -> list[Piece]:
    """Create a sung copy of the start of a recording; an empty list if it has no voice."""
    speech = as_floats(piece.samples[:_MAX_SUNG_SAMPLES])
    sung = sing(speech, len(speech) // POSITION_SAMPLES, rng)
    if sung is None:
        return []
    targets = np.array(piece.targets[sung.source])
    targets[:, PITCH] = sung.pitch
    targets[sung.is_sung & (targets[:, VOICE] == Voice.SPEECH), VOICE] = Voice.SUNG
    num_positions = min(len(targets), len(sung.samples) // POSITION_SAMPLES)
    samples = as_integers(sung.samples[: POSITION_SAMPLES * num_positions])
    return [Piece(samples, targets[:num_positions], piece.weight)]
