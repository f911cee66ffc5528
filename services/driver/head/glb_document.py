"""Writes binary glTF (GLB) files: the JSON description, accessors and sparse accessors.

pygltflib is not used. It cannot create accessors from arrays, so this code would still be needed.
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Floats
from kouxing.shared.files.output_file import open_output

ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
MAX_SHORT_VERTICES = 65535  # more vertices need 4-byte indices; 65535 itself is not a valid index
_COMPONENT_TYPES = {"f4": 5126, "u4": 5125, "u2": 5123, "u1": 5121}


class GlbDocument:
    """The JSON chunk and the binary chunk of a file under construction."""

    def __init__(self) -> None:
        self.json: dict[str, list[Any]] = {
            key: []
            for key in (
                "nodes", "meshes", "materials", "textures", "images", "samplers", "skins",
                "accessors", "bufferViews", "animations",
            )
        }  # fmt: skip
        self.binary = bytearray()

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Append an item to a list; return its index."""
        self.json[kind].append(item)
        return len(self.json[kind]) - 1

    def add_view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes, aligned to four; return the index of their buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self.binary),
            "byteLength": len(data),
        }
        if target is not None:
            view["target"] = target
        self.binary += data
        return self.add("bufferViews", view)

    def add_accessor(
        self,
        array: NDArray[Any],
        kind: str,
        *,
        target: int | None = ARRAY_BUFFER,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """Store an array (N,) or (N, components); return the index of its accessor."""
        item: dict[str, Any] = {
            "bufferView": self.add_view(np.ascontiguousarray(array).tobytes(), target),
            "componentType": _COMPONENT_TYPES[array.dtype.str[1:]],
            "count": len(array),
            "type": kind,
        }
        if normalized:
            item["normalized"] = True
        if bounds:
            item["min"], item["max"] = (
                np.atleast_1d(limit).tolist() for limit in (array.min(axis=0), array.max(axis=0))
            )
        return self.add("accessors", item)

    def add_sparse_vectors(self, rows: NDArray[np.intp], values: Floats, count: int) -> int:
        """Store displacements (count, 3), zero outside ``rows``; return their accessor's index."""
        number = np.uint16 if count <= MAX_SHORT_VERTICES else np.uint32
        padded = np.concatenate([values, np.zeros((int(len(rows) < count), 3), np.float32)])
        return self.add(
            "accessors",
            {
                "componentType": _COMPONENT_TYPES["f4"],
                "count": count,
                "type": "VEC3",
                "min": padded.min(axis=0).tolist(),
                "max": padded.max(axis=0).tolist(),
                "sparse": {
                    "count": len(rows),
                    "indices": {
                        "bufferView": self.add_view(rows.astype(number).tobytes()),
                        "componentType": _COMPONENT_TYPES[np.dtype(number).str[1:]],
                    },
                    "values": {"bufferView": self.add_view(values.tobytes())},
                },
            },
        )

    def save(self, path: Path, **rest: Any) -> None:
        """Write the file. Raises ``UserError`` if the file cannot be written."""
        lists = {kind: items for kind, items in self.json.items() if items}  # empty is not allowed
        document = {"asset": {"version": "2.0", "generator": "kouxing"}, **lists, **rest}
        document["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = bytes(self.binary) + b"\0" * (-len(self.binary) % 4)
        length = 12 + 8 + len(text) + 8 + len(binary)
        with open_output(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, length))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)
