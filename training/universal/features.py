"""Features of recordings: hidden layers of the block network, standardized, in 8 bits, on disk.

    z = round(clip((h - mean) / deviation, -6, 6) * 127 / 6)

======== ====================================================== ======================
symbol   meaning                                                shape
======== ====================================================== ======================
h        layers of the positions of a block and its right       (blocks, B + R, 1024)
         context
mean,    of some recordings' positions                          (1024,)
deviation
======== ====================================================== ======================
"""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.feature_cache import load_or_compute, read_audio
from kouxing.corpora.speech_corpus import Utterance
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.shared.arrays import Floats
from kouxing.shared.command.terminal import write_text
from kouxing.training.networks.network import MAX_DEVIATIONS
from kouxing.training.seed import SEED
from kouxing.training.universal.encoder import BLOCK_LENGTH, LENGTH, MAX_FRAMES, FeatureEncoder

LAYERS = (-2, -1)  # the last layers of the block network
WIDTH = 512 * len(LAYERS)
STEP = MAX_DEVIATIONS / 127  # step of the integers, deviations
_BATCH = 8  # recordings that are encoded together
_SHARD = 400  # recordings in a file
_NUM_STANDARDIZED = 240  # recordings for mean and deviation


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """The features of a recording."""

    name: str  # name of the recording
    num_frames: int
    rows: NDArray[np.int8]  # (blocks, B + R, 1024)

    def position_features(self) -> Floats:
        """Return the features of the positions, (positions, 1024)."""
        rows = self.rows[:, :BLOCK_LENGTH].reshape(-1, WIDTH)[: -(-self.num_frames // 2)]
        return rows.astype(np.float32) * np.float32(STEP)


class FeatureStore:
    """Features in a folder, computed once."""

    def __init__(self, folder: Path, encoder: FeatureEncoder) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._encoder = folder, encoder
        self.mean = self.deviation = np.empty(0, np.float32)

    def standardize(self, recordings: Sequence[Utterance]) -> None:
        """Compute mean and deviation from some recordings, or read them."""

        def compute() -> dict[str, Floats]:
            size = min(_NUM_STANDARDIZED, len(recordings))
            features = []
            for number in np.random.default_rng(SEED).choice(len(recordings), size, replace=False):
                frames = _frames_of(recordings[number])
                (rows,) = self._encoder.encode([frames])
                positions = rows[:, :BLOCK_LENGTH].reshape(-1, WIDTH)[: len(frames) // 2]
                features.append(positions.astype(np.float32))
            joined = np.concatenate(features)
            return {"mean": joined.mean(axis=0), "deviation": joined.std(axis=0) + 1e-3}

        stored = load_or_compute(self._folder / "standard.npz", compute)
        self.mean, self.deviation = stored["mean"], stored["deviation"]

    def read(self, recordings: Sequence[Utterance]) -> Iterator[Features]:
        """Yield the features of recordings, computed if they are missing."""
        wanted = {recording.utterance_id for recording in recordings}
        known: set[str] = set()
        for index in sorted(self._folder.glob("*.json")):
            for features in _read_shard(index):
                known.add(features.name)
                if features.name in wanted:
                    yield features
        missing = [recording for recording in recordings if recording.utterance_id not in known]
        missing.sort(key=lambda recording: recording.seconds)
        for start in track(range(0, len(missing), _SHARD), "features"):
            shard = missing[start : start + _SHARD]
            digest = hashlib.sha256(
                " ".join(recording.utterance_id for recording in shard).encode()
            )
            index = self._folder / f"{digest.hexdigest()[:8]}.json"
            self._write(shard, index)
            yield from _read_shard(index)

    def _write(self, recordings: Sequence[Utterance], index: Path) -> None:
        entries, first = [], 0
        with index.with_suffix(".i8").open("wb") as file:
            for start in range(0, len(recordings), _BATCH):
                batch = recordings[start : start + _BATCH]
                frames = [_frames_of(recording) for recording in batch]
                encoded = self._encoder.encode(frames)
                for recording, recording_frames, rows in zip(batch, frames, encoded, strict=True):
                    standard = (rows.astype(np.float32) - self.mean) / self.deviation
                    integers = np.clip(np.rint(standard * (1 / STEP)), -127, 127).astype(np.int8)
                    file.write(integers.tobytes())
                    entries.append(
                        (recording.utterance_id, len(recording_frames), first, len(rows))
                    )
                    first += len(rows)
        write_text(index, json.dumps(entries))


def _read_shard(index: Path) -> Iterator[Features]:
    rows = np.memmap(index.with_suffix(".i8"), np.int8, "r").reshape(-1, LENGTH, WIDTH)
    for name, num_frames, first, num_blocks in json.loads(index.read_text()):
        yield Features(name=name, num_frames=num_frames, rows=rows[first : first + num_blocks])


def _frames_of(recording: Utterance) -> Floats:
    """Return log-mel frames, (n, 80)."""
    return WhisperMel().accept_waveform(read_audio(recording.path))[:MAX_FRAMES]
