"""Reads the positions of MPEG-4 feature points on a mesh.

A file has lines ``point x y z``, in the mesh's own axes and unit, or ``point vertex``, counted from
0 in file order; ``#`` starts a comment.
"""

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.errors import UserError
from kouxing.shared.user_file import read_file

MAX_BYTES = 4 * 1024 * 1024
# ISO/IEC 14496-2, annex C: number of points per group
_GROUP_SIZES = {2: 14, 3: 14, 4: 6, 5: 4, 6: 4, 7: 1, 8: 10, 9: 15, 10: 10, 11: 6}

Position = NDArray[np.float64]


def read_points(path: Path) -> dict[str, Position | int]:
    """Read coordinates (3,) or vertex numbers by point.

    Raises ``UserError`` if the file cannot be read or is invalid; the text names the line.
    """
    text = read_file(path, MAX_BYTES).decode("utf-8-sig", "replace")
    positions: dict[str, Position | int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words or (number == 1 and not words[0][0].isdigit()):
            continue  # empty line, or column names
        where = f"{path}, line {number}"
        name = _known(words[0], where, positions)
        try:
            values = [float(word) for word in words[1:]]
        except ValueError:
            raise UserError(f"{where}: {line.strip()!r} contains an invalid number") from None
        if len(values) == 3 and all(map(math.isfinite, values)):
            positions[name] = np.array(values)
        elif len(values) == 1 and values[0] >= 0 and values[0] == int(values[0]):
            positions[name] = int(values[0])
        else:
            raise UserError(f"{where}: expected 'point x y z' or 'point vertex'")
    if not positions:
        raise UserError(f"{path} has no feature points; write lines such as '2.1 0.0 -0.07 0.07'")
    return positions


def _known(name: str, where: str, positions: dict[str, Position | int]) -> str:
    match = re.fullmatch(r"(\d+)\.(\d+)", name)
    if not match or not 1 <= int(match[2]) <= _GROUP_SIZES.get(int(match[1]), 0):
        raise UserError(f"{where}: {name!r} is not an MPEG-4 feature point, such as 2.1")
    if name in positions:
        raise UserError(f"{where}: {name} occurs twice; delete one line")
    return name
