"""Recordings with the targets of the audio encoder, computed once and kept on disk.

The recordings are shuffled, and split into chunks that are computed in parallel. Each target file
has these columns:

========= ===================================================================== ========
columns   meaning (:mod:`kouxing.training.encoder.teachers`)                        number
========= ===================================================================== ========
pitch     log2 of Hz, NaN without voice                                         1
level     relative to the recording                                             1
effort    balance of high and low frequencies                                   1
voice     number of a :class:`VoiceKind`                                            1
phones    posteriors                                                            phones
whisper   principal components of Whisper's encoder                             128
lips      outputs of the lip teacher, standardized                              17
========= ===================================================================== ========

A principal component is divided by the square root of its standard deviation, so that later
components have less weight. Some recordings also have a sung or held copy.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.feature_cache import load_or_compute
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.encoder import VoiceKind
from kouxing.shared.arrays import Float16, Floats, Int16, Mask
from kouxing.shared.audio.pcm import as_floats, as_integers
from kouxing.shared.command.terminal import write_text
from kouxing.shared.errors import UserError
from kouxing.training.encoder.lip_teacher import LipTeacher, TeacherFeatures
from kouxing.training.encoder.singing import sing
from kouxing.training.encoder.teachers import ENCODER_FRAME_SAMPLES, TeacherOutputs, Teachers
from kouxing.training.seed import SEED

Samples = Int16  # 16 kHz

PITCH, LEVEL, EFFORT, VOICE = range(4)  # columns
NUM_COMPONENTS = 128
CHUNK_SIZE = 64  # recordings
_NUM_FITTED = 192  # recordings that the principal components are computed from
_SUNG_PROB = 0.25
MAX_SUNG_SAMPLES = 64_000  # limit for the sung part of the speech
MIN_SAMPLES, MAX_SAMPLES = 8000, 320_000
_SILENT = 0.5  # posterior of silence above which a position is not speech
_LAUGHING_LEVEL = -2.0  # level above which laughter is audible
_MIN_VARIANCE = 1e-6


@dataclass(frozen=True, slots=True)
class SourceRecording:
    """A recording to train on."""

    name: str
    read: Callable[[], Samples]  # UserError if it cannot be read
    weight: float  # relative sampling frequency
    voice: VoiceKind = VoiceKind.SPEECH  # frames in which the sound is audible


@dataclass(frozen=True, slots=True)
class Piece:
    """A recording, or a part of one, with its targets."""

    samples: Samples  # (320 positions,)
    targets: Float16  # (positions, columns)
    weight: float


@dataclass(frozen=True, slots=True)
class TargetColumns:
    """The target columns that are ranges."""

    num_phones: int

    @property
    def phones(self) -> slice:
        """Posteriors of the phones."""
        return slice(VOICE + 1, VOICE + 1 + self.num_phones)

    @property
    def whisper(self) -> slice:
        """Components of Whisper's encoder."""
        return slice(self.phones.stop, self.phones.stop + NUM_COMPONENTS)

    @property
    def lips(self) -> slice:
        """Outputs of the lip teacher; in a batch, of each delay."""
        return slice(self.whisper.stop, None)


class TargetStore:
    """The chunks in a folder."""

    def __init__(
        self,
        folder: Path,
        recordings: Sequence[SourceRecording],
        teachers: Teachers,
        lip_teacher: LipTeacher,
        errors: RowErrors,
    ) -> None:
        """Open a folder; UserError if it has targets of other recordings, or no usable recording.

        ``errors`` receives a message for every recording that cannot be read.
        """
        self._folder, self._errors = folder, errors
        self._teachers, self._lip_teacher = teachers, lip_teacher
        rng = np.random.default_rng(SEED)
        order = rng.exponential(size=len(recordings)) / [
            recording.weight for recording in recordings
        ]
        self._recordings = [recordings[number] for number in np.argsort(order)]
        self.num_chunks = -(-len(recordings) // CHUNK_SIZE)
        folder.mkdir(parents=True, exist_ok=True)
        self._check_key()
        self.basis = load_or_compute(folder / "basis.npz", self._compute_basis)

    def pieces(self) -> list[Piece]:
        """Return the pieces of all recordings; compute those that are missing."""
        chunks = range(self.num_chunks)
        missing = [number for number in chunks if not self._file(number, "ends").exists()]
        computed = process_in_order(self._compute, missing)
        for errors in track(computed, "targets", len(missing)):
            for name, message in errors:
                self._errors.add(name, message)
        return [piece for number in chunks for piece in self._load(number)]

    def _check_key(self) -> None:
        key = hashlib.sha256(f"3 {SEED} {self._teachers.digest}".encode())
        for recording in self._recordings:
            key.update(f"{recording.name} {recording.voice}\n".encode())
        path = self._folder / "key"
        if not path.exists():
            write_text(path, key.hexdigest())
        elif path.read_text() != key.hexdigest():
            raise UserError(
                f"{self._folder} contains targets of other recordings or models; delete it"
            )

    def _compute_basis(self) -> dict[str, Floats]:
        """Compute the bases of components and lips from the first recordings."""
        speech = [
            recording for recording in self._recordings if recording.voice == VoiceKind.SPEECH
        ][:_NUM_FITTED]
        sounds = [sound for recording in speech for sound in _cut(recording)]
        computed = process_in_order(self._teachers.compute_targets, sounds)
        features = [TeacherFeatures(outputs.whisper, outputs.phones) for outputs in computed]
        whisper = np.concatenate([outputs.whisper for outputs in features])
        lips = np.concatenate([self._lip_teacher.predict_lips(outputs) for outputs in features])
        return {
            "whisper_mean": whisper.mean(axis=0),
            "whisper": _components_of(whisper - whisper.mean(axis=0)),
            "lips_mean": lips.mean(axis=0),
            "lips_deviation": lips.std(axis=0),
        }

    def _file(self, chunk: int, name: str) -> Path:
        return self._folder / f"{chunk:04}.{name}.npy"

    def _load(self, chunk: int) -> list[Piece]:
        lengths, weights = np.load(self._file(chunk, "ends")).T
        if not len(lengths):
            return []
        bounds = np.cumsum(lengths[:-1]).astype(np.int64)
        samples, targets = (
            np.load(self._file(chunk, name), mmap_mode="r") for name in ("samples", "targets")
        )
        parts = np.split(samples, ENCODER_FRAME_SAMPLES * bounds), np.split(targets, bounds)
        return [Piece(*fields) for fields in zip(*parts, weights.tolist(), strict=True)]

    def _compute(self, chunk: int) -> list[tuple[str, str]]:
        """Compute and store a chunk; return the recordings that cannot be read, with messages."""
        torch.set_num_threads(1)
        rng = np.random.default_rng([SEED, chunk])
        pieces, errors = [], []
        for recording in self._recordings[CHUNK_SIZE * chunk :][:CHUNK_SIZE]:
            try:
                recording_pieces = self.pieces_of(recording)
            except UserError as error:
                errors.append((recording.name, str(error)))
                continue
            for piece in recording_pieces:
                pieces.append(piece)
                if recording.voice == VoiceKind.SPEECH and rng.random() < _SUNG_PROB:
                    pieces += _sung_copy(piece, rng)
        if pieces:
            for name in ("samples", "targets"):
                rows = np.concatenate([getattr(piece, name) for piece in pieces])
                np.save(self._file(chunk, name), rows)
        ends = self._file(chunk, "ends")
        rows = np.array([(len(piece.targets), piece.weight) for piece in pieces]).reshape(-1, 2)
        unfinished = ends.with_suffix(".part.npy")
        np.save(unfinished, rows)
        unfinished.replace(ends)  # it marks the chunk as complete
        return errors

    def pieces_of(self, recording: SourceRecording) -> list[Piece]:
        """Compute the targets of a recording; UserError if it cannot be read."""
        pieces = []
        for samples in _cut(recording):
            outputs = self._teachers.compute_targets(samples)
            voice = np.full(len(outputs.level), recording.voice, np.float32)
            voice[~self._is_audible(outputs, recording.voice)] = VoiceKind.NONE
            scalars = [outputs.pitch, outputs.level, outputs.effort, voice]
            whisper = (outputs.whisper - self.basis["whisper_mean"]) @ self.basis["whisper"]
            lips = self._lip_teacher.predict_lips(TeacherFeatures(outputs.whisper, outputs.phones))
            lips = (lips - self.basis["lips_mean"]) / self.basis["lips_deviation"]
            rows: list[NDArray[np.floating]] = [*scalars, outputs.phones, whisper, lips]
            targets = np.column_stack(rows).astype(np.float16)
            trimmed = samples[: ENCODER_FRAME_SAMPLES * len(targets)]
            pieces.append(Piece(trimmed, targets, recording.weight))
        return pieces

    def _is_audible(self, outputs: TeacherOutputs, voice: VoiceKind) -> Mask:
        if voice == VoiceKind.SPEECH:
            return np.asarray(outputs.phones[:, self._teachers.silence] < _SILENT)
        return np.asarray(outputs.level > _LAUGHING_LEVEL)


def _cut(recording: SourceRecording) -> list[Samples]:
    """Read a recording in parts of up to 20 s; UserError if it cannot be read."""
    samples = recording.read()
    starts = range(0, max(1, len(samples) - MIN_SAMPLES), MAX_SAMPLES)
    parts = [samples[start : start + MAX_SAMPLES] for start in starts]
    return [part for part in parts if len(part) >= MIN_SAMPLES]


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
    speech = as_floats(piece.samples[:MAX_SUNG_SAMPLES])
    sung = sing(speech, len(speech) // ENCODER_FRAME_SAMPLES, rng)
    if sung is None:
        return []
    targets = np.array(piece.targets[sung.source])
    targets[:, PITCH] = sung.pitch
    targets[sung.is_sung & (targets[:, VOICE] == VoiceKind.SPEECH), VOICE] = VoiceKind.SUNG
    num_positions = min(len(targets), len(sung.samples) // ENCODER_FRAME_SAMPLES)
    samples = as_integers(sung.samples[: ENCODER_FRAME_SAMPLES * num_positions])
    return [Piece(samples, targets[:num_positions], piece.weight)]
