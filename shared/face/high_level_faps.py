"""Converts FAP 1 (viseme) and FAP 2 (expression) to low-level FAPs.

ISO/IEC 14496-2, annex C: FAP 1 blends two of 14 visemes, FAP 2 two of six expressions. The
standard describes them only in words. The values in ``high_level.tsv`` are from Crystal TTVS
(Tsinghua HCSI, Apache-2.0): its expressions, and its Mandarin visemes that are closest to the
standard's English ones. Deviations:

- "th", "tS dZ S" and "r" are mixtures of several Mandarin visemes.
- The tip of the tongue rises in "th", "t d" and "n l"; its body rises in "k g" and "I".
- The lower lip draws in for "f v".
- Brows, lids and cheeks move less. With the original values, brows would cross and the middle of a
  worried brow would sink.
- Disgust raises both sides of the lip.
"""

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.files.tsv_tables import read_table

FULL = 63  # highest viseme_blend and expression_intensity


def fap_table(name: str) -> tuple[list[dict[str, str]], Floats]:
    """Read a table of this package: its rows, and its columns ``fapN`` as FAPs (rows, 68)."""
    rows = read_table(__package__, name)
    values = np.zeros((len(rows), NUM_FAPS), np.float32)
    for row, target in zip(rows, values, strict=True):
        for column, value in row.items():
            if column.startswith("fap"):
                target[int(column.removeprefix("fap")) - 1] = float(value)
    return rows, values


def _read(kind: str) -> tuple[tuple[str, ...], Floats]:
    rows, values = fap_table("high_level.tsv")
    indices = [number for number, row in enumerate(rows) if row["kind"] == kind]
    return tuple(rows[number]["name"] for number in indices), values[indices]


VISEME_NAMES, VISEMES = _read("viseme")  # (15, 68), row 0 is "none"
EXPRESSION_NAMES, EXPRESSIONS = _read("expression")  # (7, 68), row 0 is neutral


def viseme_faps(select1: int, select2: int, blend: float) -> Floats:
    """Blend two visemes (0 for none, 1 to 14) into low-level FAPs (68,).

    ``blend`` goes from 0 (second viseme only) to 63 (first viseme only).
    """
    fraction = np.float32(blend / FULL)
    blended: Floats = VISEMES[select1] * fraction + VISEMES[select2] * (1 - fraction)
    return blended


def expression_faps(
    select1: int, intensity1: float, select2: int = 0, intensity2: float = 0.0
) -> Floats:
    """Add two expressions into low-level FAPs (68,).

    Expressions: 1 joy, 2 sadness, 3 anger, 4 fear, 5 disgust, 6 surprise; 0 for none. Intensities
    go from 0 to 63.
    """
    first, second = np.float32(intensity1 / FULL), np.float32(intensity2 / FULL)
    added: Floats = EXPRESSIONS[select1] * first + EXPRESSIONS[select2] * second
    return added
