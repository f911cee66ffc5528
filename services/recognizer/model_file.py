"""Model files: npz archives of plain arrays, never pickle, every size checked."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import NUM_POSITIONS, Topology
from shared.errors import UserError
from shared.phones import UNITS

_MOST_STATES = 10_000


@dataclass(frozen=True, slots=True)
class Archive:
    """The arrays of a model file."""

    arrays: dict[str, NDArray[Any]]

    def __contains__(self, name: str) -> bool:
        return name in self.arrays

    def array(self, name: str, shape: tuple[int, ...] | None) -> NDArray[Any]:
        """Return an array of a given shape (None: any); ValueError says what does not fit."""
        if name not in self.arrays:
            raise ValueError(f"{name} is missing")
        found = self.arrays[name]
        if shape is not None and found.shape != shape:
            raise ValueError(f"{name} has shape {found.shape}, expected {shape}")
        return found

    def floats(self, name: str, *shape: int) -> NDArray[np.float32]:
        """Return finite numbers of a given shape."""
        values = self.array(name, shape).astype(np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds values that are no numbers")
        return values


def read_archive(path: Path) -> Archive:
    """Read a model file.

    Raises
    ------
    UserError
        If the file is missing or no model file.
    """
    try:
        content = io.BytesIO(path.read_bytes())
    except OSError as error:
        raise UserError(f"no acoustic model at {path}; train one or reinstall") from error
    try:
        with np.lib.npyio.NpzFile(content, allow_pickle=False) as archive:
            return Archive({name: archive[name] for name in archive.files})
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is no acoustic model ({error}); train one or reinstall") from error


def write_archive(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write a model file."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    path.write_bytes(buffer.getvalue())


def topology_arrays(topology: Topology) -> dict[str, NDArray[Any]]:
    """Arrays of the search part."""
    return {
        "units": np.array(UNITS),
        "first_state": topology.first_state,
        "log_stay": topology.log_stay,
        "log_leave": topology.log_leave,
        "log_bigram": topology.log_bigram,
        "duration_mean_s": topology.duration_mean_s,
        "duration_spread_s": topology.duration_spread_s,
    }


def topology_from(archive: Archive) -> Topology:
    """Build the search part after checking every size; ValueError says what does not fit."""
    num_units = len(UNITS)
    if tuple(archive.array("units", (num_units,)).tolist()) != UNITS:
        raise ValueError("its units are not the 60 of this program")
    first_state = archive.array("first_state", (num_units + 1,)).astype(np.int64)
    if first_state[0] != 0 or (np.diff(first_state) < 1).any() or first_state[-1] > _MOST_STATES:
        raise ValueError("its states are not numbered upwards")
    num_states = int(first_state[-1])
    after_two = archive.array("log_bigram", None).ndim == 3
    return Topology(
        first_state=first_state,
        log_stay=archive.floats("log_stay", num_states),
        log_leave=archive.floats("log_leave", num_states),
        log_bigram=archive.floats("log_bigram", *[num_units] * (3 if after_two else 2)),
        duration_mean_s=archive.floats("duration_mean_s", NUM_POSITIONS, num_units),
        duration_spread_s=archive.floats("duration_spread_s", NUM_POSITIONS, num_units),
    )
