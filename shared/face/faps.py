"""The 68 facial animation parameters (FAPs) of MPEG-4 (ISO/IEC 14496-2, annex C).

An array of FAPs has shape ``(68,)``; index ``i`` holds FAP ``i + 1`` in FAP units: a displacement
is ``value * FAPU / 1024``, an angle ``value * 1e-5`` rad.
"""

import math
from dataclasses import dataclass

from kouxing.shared.files.tsv_tables import read_table

NUM_FAPS = 68
FAP_UNITS_PER_FAPU = 1024.0
RADIANS_PER_ANGLE_UNIT = 1e-5
DEGREE = math.radians(1.0) / RADIANS_PER_ANGLE_UNIT  # FAP units of an angle


@dataclass(frozen=True, slots=True)
class Fap:
    """One row of the standard's table."""

    number: int  # 1 to 68
    name: str
    fapu: str  # unit: MNS MW IRISD ES ENS AU; empty for FAP 1 and 2
    direction: str  # direction of positive values; "left" is the subject's left
    feature_points: tuple[str, ...]  # points that this FAP moves, such as "2.1"


FAPS = tuple(
    Fap(
        number=int(row["fap"]),
        name=row["name"],
        fapu=row["fapu"],
        direction=row["direction"],
        feature_points=tuple(point for point in row["feature_points"].split(",") if point),
    )
    for row in read_table(__package__, "faps.tsv")
)
MOUTH_FAPS = (*range(3, 15), 16, 17, *range(44, 48), *range(51, 61))  # jaw, lips and tongue
NUM_MOUTH_FAPS = len(MOUTH_FAPS)
# heights of six points of each lip, those of the inner lip first; positive closes the mouth
UPPER_LIP_FAPS = (4, 8, 9, 51, 55, 56)
LOWER_LIP_FAPS = (5, 10, 11, 52, 57, 58)
LIP_HEIGHT_FAPS = tuple(sorted(UPPER_LIP_FAPS + LOWER_LIP_FAPS))
MOUTH_WIDTH_FAPS = (6, 7, 53, 54)  # corners; positive is outward
PROTRUSION_FAPS = (16, 17)
TONGUE_FAPS = (44, 45, 46, 47)
FAP_NUMBER = {fap.name: fap.number for fap in FAPS}
