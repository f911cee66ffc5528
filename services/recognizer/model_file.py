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
from services.recognizer.unit_language import MOST_UNITS, UnitLanguage
from shared.errors import UserError
from shared.phones import UNITS

_MOST_STATES = 10_000
_MOST_NODES = 10_000_000
_MOST_WEIGHT = 10.0
_STEP = np.float32(0.05)  # nats; the logs of a language are kept in whole steps


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
        **language_arrays(topology.language),
        "language_scale": np.array(topology.language_scale, np.float32),
        "unit_penalty": np.array(topology.unit_penalty, np.float32),
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
    language_scale = float(archive.floats("language_scale"))
    unit_penalty = float(archive.floats("unit_penalty"))
    if not 0 <= language_scale <= _MOST_WEIGHT or abs(unit_penalty) > _MOST_WEIGHT:
        raise ValueError(f"language scale {language_scale:g}, unit penalty {unit_penalty:g}")
    return Topology(
        first_state=first_state,
        log_stay=archive.floats("log_stay", num_states),
        log_leave=archive.floats("log_leave", num_states),
        language=language_from(archive),
        language_scale=language_scale,
        unit_penalty=unit_penalty,
        duration_mean_s=archive.floats("duration_mean_s", NUM_POSITIONS, num_units),
        duration_spread_s=archive.floats("duration_spread_s", NUM_POSITIONS, num_units),
    )


def language_arrays(language: UnitLanguage) -> dict[str, NDArray[Any]]:
    """Arrays of the language of units."""
    share, back_off = (np.rint(log / _STEP) for log in (language.log_share, language.log_back_off))
    return {
        "language_children": language.num_children,
        "language_unit": language.unit,
        "language_share": np.clip(-share, 0, 255).astype(np.uint8),
        "language_back_off": np.clip(back_off, -127, 127).astype(np.int8),
    }


def language_from(archive: Archive) -> UnitLanguage:
    """Build the language of units after checking every number."""
    num_units = len(UNITS)
    children = archive.array("language_children", None).astype(np.int64)
    if children.ndim != 1 or not 1 + num_units <= len(children) <= _MOST_NODES:
        raise ValueError(f"its language is of shape {children.shape}")
    at = np.arange(len(children))
    first_child = 1 + np.cumsum(children) - children
    if (
        children.min() < 0
        or children[0] != num_units
        or children.sum() != len(children) - 1
        or (first_child <= at)[children > 0].any()
    ):
        raise ValueError("its language is no tree")
    unit = archive.array("language_unit", children.shape).astype(np.int64)
    is_first = np.zeros(len(unit) + 1, dtype=bool)
    is_first[first_child] = True
    if unit.min() < 0 or unit.max() >= num_units or (np.diff(unit) < 1)[~is_first[1:-1]].any():
        raise ValueError("the units of its language are not in order")
    language = UnitLanguage(
        num_children=children.astype(np.uint8),
        unit=unit.astype(np.uint8),
        log_share=-_STEP * archive.floats("language_share", len(unit)),
        log_back_off=_STEP * archive.floats("language_back_off", len(unit)),
    )
    if len(language.levels) > MOST_UNITS + 2:
        raise ValueError(f"its language counts more than {MOST_UNITS} units together")
    return language
