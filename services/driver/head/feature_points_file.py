"""Reads files with the positions of MPEG-4 feature points on a mesh.

Two formats are accepted. Text files have lines ``point x y z``, in the mesh's own axes and unit, or
``point vertex``, counted from 0 in file order; ``#`` starts a comment. XfaceEd's ``.fdp`` files
(XML) name a vertex of a mesh by ``<fdp name="2.1" affects="MESH" index="VERTEX">`` and lengths by
``<fapu>``. The zones and weights of an ``.fdp`` file are ignored: fields are computed from the
surface, as for the built-in heads.
"""

import math
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import read_file

MAX_BYTES = 4 * 1024 * 1024
# ISO/IEC 14496-2, annex C: number of points per group
_GROUP_SIZES = {2: 14, 3: 14, 4: 6, 5: 4, 6: 4, 7: 1, 8: 10, 9: 15, 10: 10, 11: 6}
_FAPU_LENGTHS = ("MNS", "MW", "ENS", "ES", "IRISD")

Position = Doubles


@dataclass(frozen=True, slots=True)
class FeaturePoints:
    """The contents of a file of feature points."""

    positions: dict[str, Position | tuple[str, int]]
    """coordinates (3,), or mesh name (may be empty) and vertex"""
    fapu: dict[str, float] = field(default_factory=dict)  # lengths in the mesh's own unit


def read_points(path: Path) -> FeaturePoints:
    """Read a file of feature points.

    Raises ``UserError`` if the file cannot be read or is invalid; the text names the line if
    possible.
    """
    text = read_file(path, MAX_BYTES).decode("utf-8-sig", "replace")
    points = _parse_xml(path, text) if text.lstrip().startswith("<") else _parse_lines(path, text)
    if not points.positions:
        raise UserError(f"{path} has no feature points; write lines such as '2.1 0.0 -0.07 0.07'")
    return points


def _parse_lines(path: Path, text: str) -> FeaturePoints:
    positions: dict[str, Position | tuple[str, int]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words or (number == 1 and not words[0][0].isdigit()):
            continue  # empty line, or column names
        where = f"{path}, line {number}"
        name = _check_name(words[0], where, positions)
        try:
            values = [float(word) for word in words[1:]]
        except ValueError:
            raise UserError(f"{where}: {line.strip()!r} contains an invalid number") from None
        if len(values) == 3 and all(map(math.isfinite, values)):
            positions[name] = np.array(values)
        elif len(values) == 1 and values[0] >= 0 and values[0].is_integer():
            positions[name] = ("", int(values[0]))
        else:
            raise UserError(f"{where}: expected 'point x y z' or 'point vertex'")
    return FeaturePoints(positions)


def _parse_xml(path: Path, text: str) -> FeaturePoints:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise UserError(f"{path}: .fdp files must not have a document type; remove it")
    try:
        root = ET.fromstring(text)  # noqa: S314 - entities are rejected above
    except ET.ParseError as error:
        raise UserError(f"{path}: invalid XML: {error}; export it again") from error
    positions: dict[str, Position | tuple[str, int]] = {}
    for entry in root.iter("fdp"):
        if "name" not in entry.attrib:
            continue
        where = f"{path}, <fdp name={entry.attrib['name']!r}>"
        name = _check_name(entry.attrib["name"], where, positions)
        try:
            number = int(entry.attrib["index"])
        except (KeyError, ValueError):
            raise UserError(
                f"{where}: the vertex index is missing or invalid; export it again"
            ) from None
        if number < 0:
            raise UserError(f"{where}: the vertex index {number} is negative; count from 0")
        positions[name] = (entry.attrib.get("affects", ""), number)
    fapu = {}
    for entry in root.iter("fapu"):
        for name in _FAPU_LENGTHS:
            try:
                length = float(entry.attrib.get(f"{name}0", "nan"))
            except ValueError:
                length = math.nan
            if 0 < length < math.inf:
                fapu[name] = length
    return FeaturePoints(positions, fapu)


def _check_name(name: str, where: str, positions: dict[str, Position | tuple[str, int]]) -> str:
    match = re.fullmatch(r"(\d+)\.(\d+)", name)
    if not match or not 1 <= int(match[2]) <= _GROUP_SIZES.get(int(match[1]), 0):
        raise UserError(f"{where}: {name!r} is not an MPEG-4 feature point, such as 2.1")
    if name in positions:
        raise UserError(f"{where}: {name} occurs twice; delete one line")
    return name
