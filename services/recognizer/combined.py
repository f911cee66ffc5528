"""Two acoustic models that listen together.

Their log scores are added, each times its own weight: a mixture model and a network make different
mistakes (log-linear combination, Beyerlein 1998, "Discriminative model combination").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import AcousticModel, AcousticStream, Topology
from services.recognizer.model_file import (
    Archive,
    topology_arrays,
    topology_from,
    write_archive,
)

FORMAT = "combined 1"


@dataclass(frozen=True, slots=True, kw_only=True)
class CombinedModel:
    """Models of the same states; implements ``AcousticModel``."""

    topology: Topology
    parts: tuple[AcousticModel, ...]
    scales: tuple[float, ...]  # of each part's log scores

    def stream(self) -> CombinedStream:
        """Start a stream of scores for one speaker."""
        return CombinedStream([part.stream() for part in self.parts], self.scales)


class CombinedStream:
    """Scores of one speaker's speech; a frame is ready when the slowest part has scored it."""

    def __init__(self, streams: Sequence[AcousticStream], scales: Sequence[float]) -> None:
        self._streams = streams
        self._scales = [np.float32(scale) for scale in scales]
        self.look_ahead_frames = max(stream.look_ahead_frames for stream in streams)
        self._waiting: list[list[NDArray[np.float32]]] = [[] for _ in streams]

    def accept(self, log_mel: NDArray[np.float32]) -> NDArray[np.float32]:
        """Take log-mel frames, shape (n, 41); return the scores ready, (m, states)."""
        return self._add([stream.accept(log_mel) for stream in self._streams])

    def finish(self) -> NDArray[np.float32]:
        """End the segment and return the scores still owed."""
        return self._add([stream.finish() for stream in self._streams])

    def reset(self) -> None:
        """Forget the segment and the speaker."""
        for stream, waiting in zip(self._streams, self._waiting, strict=True):
            stream.reset()
            waiting.clear()

    def _add(self, scores: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        for rows, waiting in zip(scores, self._waiting, strict=True):
            waiting.extend(rows)
        num_ready = min(len(waiting) for waiting in self._waiting)
        total = np.zeros((num_ready, scores[0].shape[1]), dtype=np.float32)
        for waiting, scale in zip(self._waiting, self._scales, strict=True):
            for row in range(num_ready):
                total[row] += scale * waiting[row]
            del waiting[:num_ready]
        return total


def save_combined(
    path: Path, topology: Topology, part_files: Sequence[str], scales: Sequence[float]
) -> None:
    """Write which model files, in the same folder, listen together."""
    arrays = {
        "format": np.array(FORMAT),
        **topology_arrays(topology),
        "part_files": np.array(part_files),
        "scales": np.array(scales, np.float32),
    }
    write_archive(path, arrays)


def part_files_of(archive: Archive) -> list[str]:
    """Names of the parts' files; ValueError if one is not a plain file name."""
    names = [str(name) for name in archive.array("part_files", None).reshape(-1)]
    if not names or any(Path(name).name != name for name in names):
        raise ValueError("its part files are not plain file names")
    return names


def combined_from(archive: Archive, parts: Sequence[AcousticModel]) -> CombinedModel:
    """Build the model after checking that the parts fit; ValueError says what does not."""
    topology = topology_from(archive)
    if any((part.topology.first_state != topology.first_state).any() for part in parts):
        raise ValueError("its parts have other states")
    scales = archive.floats("scales", len(parts))
    return CombinedModel(
        topology=topology, parts=tuple(parts), scales=tuple(float(scale) for scale in scales)
    )
