"""Visemes of sounds that Mandarin lacks, derived from trained visemes (``derived.tsv``)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import (
    LIP_HEIGHT_FAPS,
    MOUTH_FAPS,
    MOUTH_WIDTH_FAPS,
    PROTRUSION_FAPS,
    TONGUE_FAPS,
)
from kouxing.shared.files.tsv_tables import read_table

_OPENING = (3, *LIP_HEIGHT_FAPS)  # with the jaw


@dataclass(frozen=True, slots=True)
class DerivedViseme:
    """A viseme described by its difference from its base, a trained viseme."""

    name: str
    base: str
    opening: float  # factor on the opening of the base
    rounding: float  # factor on the rounding of the base
    spread: float  # added to the width, FAP units
    tongue: str  # viseme with the same tongue, or the values of TONGUE_FAPS


@cache
def load_derived_visemes() -> tuple[DerivedViseme, ...]:
    """Read the derived visemes from ``derived.tsv``."""
    return tuple(
        DerivedViseme(
            row["viseme"],
            row["base"],
            float(row["opening"]),
            float(row["rounding"]),
            float(row["spread"]),
            row["tongue"],
        )
        for row in read_table(__package__, "derived.tsv")
    )


def append_derived_visemes(
    arrays: Mapping[str, Doubles], index: Mapping[str, int]
) -> dict[str, Doubles]:
    """Append the rows of the derived visemes to arrays with a row for each trained viseme.

    ``index`` is the row of each trained viseme. A derived viseme has the dominance of its base and
    its own target. It does not close the lips.
    """
    bases = [index[viseme.base] for viseme in load_derived_visemes()]
    rows = {name: array[bases] for name, array in arrays.items()}
    if "target" in arrays:
        rows["target"] = compute_derived_targets(arrays["target"], index)
    if "closes" in arrays:
        rows["closes"] = np.zeros_like(rows["closes"])
    return {name: np.concatenate([array, rows[name]]) for name, array in arrays.items()}


def compute_derived_targets(targets: Doubles, index: Mapping[str, int]) -> Doubles:
    """Return the targets (num_derived, num_mouth_faps) from the trained visemes' targets."""
    made = np.empty((len(load_derived_visemes()), len(MOUTH_FAPS)))
    opening, width, protrusion, tongue = (
        [MOUTH_FAPS.index(fap) for fap in faps]
        for faps in (_OPENING, MOUTH_WIDTH_FAPS, PROTRUSION_FAPS, TONGUE_FAPS)
    )
    for row, viseme in zip(made, load_derived_visemes(), strict=True):
        row[:] = targets[index[viseme.base]]
        row[opening] *= viseme.opening
        row[width] = row[width] * viseme.rounding + viseme.spread
        row[protrusion] *= viseme.rounding
        values = viseme.tongue.split()
        row[tongue] = (
            targets[index[values[0]], tongue] if len(values) == 1 else [*map(float, values)]
        )
    return made
