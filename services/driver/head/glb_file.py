"""Reads glTF files (.glb, .gltf, .vrm) from untrusted sources: every size is checked before use.

Khronos glTF 2.0, sections 3.6 (accessors), 3.7 (geometry, skins, morph targets) and 4.4 (GLB).
pygltflib is not used because it does not check sizes and decodes neither accessors nor nodes. It
would replace only the 20 lines of ``_chunks``.
"""

import base64
import binascii
import contextlib
import struct
import urllib.parse
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from kouxing.services.driver.head.draco_decoder import decode_mesh, read_mesh_size
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, parse_json, read_file

MAX_BYTES = 512 << 20  # limit for all files together, unpacked
MAX_COUNT = 2_000_000  # elements of an accessor, or points of a Draco mesh
MAX_NODES = 20_000
_COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_NUM_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MESHOPT, _DRACO = "EXT_meshopt_compression", "KHR_draco_mesh_compression"
_SUPPORTED = {
    _MESHOPT, _DRACO, "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp",
}  # fmt: skip
# extensions whose data is plain glTF
_LOOK_EXTENSIONS = ("KHR_materials_", "KHR_lights_", "KHR_xmp", "VRM")


@contextlib.contextmanager
def check_glb(path: Path) -> Iterator[None]:
    """Raise ``UserError`` with the path of the GLB for every error of the enclosed code."""
    with check_content(path, "a GLB file; export it again"):
        try:
            yield
        except UserError as error:
            if str(path) in str(error):  # from reading the file
                raise
            raise UserError(f"{path}: {error}") from error


def _chunks(data: bytes) -> dict[bytes, bytes]:
    """Return the chunks of a GLB by type."""
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("it is not a binary glTF file")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise UserError(f"it has version {version} of glTF; export it as glTF 2.0")
    if length > len(data):
        raise UserError(f"it is cut off after {len(data)} of {length} bytes; copy it again")
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, offset)
        if offset + 8 + size > length:
            raise ValueError("a chunk is cut off")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    return chunks


class GlbFile:
    """A glTF file with its buffers.

    Raises ``UserError`` if the file cannot be read or requires an unsupported extension, and any
    exception if it is damaged (``check_glb``).
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        self._num_bytes = 0
        text = data = self._read(path)
        self._binary = b""
        if not data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):  # not the text of a .gltf
            chunks = _chunks(data)
            text, self._binary = chunks.get(b"JSON", b""), chunks.get(b"BIN\0", b"")
        self.json: dict[str, Any] = parse_json(text)
        needed = set(self.json.get("extensionsRequired", ()))
        unknown = {name for name in needed - _SUPPORTED if not name.startswith(_LOOK_EXTENSIONS)}
        if unknown:
            names = ", ".join(sorted(unknown))
            raise UserError(
                f"it needs {names}, which kouxing does not support; export it without them"
            )
        self._buffer = cache(self._load_buffer)
        self._decompressed = cache(self._decompress)

    def _allow(self, num_bytes: int) -> None:
        self._num_bytes += num_bytes
        if self._num_bytes > MAX_BYTES:
            raise UserError(f"it is larger than {MAX_BYTES // 2**20} MiB; reduce it")

    def _read(self, path: Path) -> bytes:
        content = read_file(path, MAX_BYTES)
        self._allow(len(content))
        return content

    def _uri(self, uri: str) -> bytes:
        """Return the data of a URI: base64, or a file in the folder of this file or below."""
        prefix, _, encoded = uri.partition(",")
        if prefix.startswith("data:"):
            try:
                return base64.b64decode(encoded) if prefix.endswith(";base64") else b""
            except binascii.Error:
                return b""
        path = Path(urllib.parse.unquote(uri))
        if path.is_absolute() or ".." in path.parts or ":" in uri or "\\" in uri:
            raise UserError(f"it refers to {uri!r}, which is not in its folder; export it as .glb")
        if not (self._folder / path).exists():
            raise UserError(f"its file {uri!r} is missing; copy it too, or export as .glb")
        return self._read(self._folder / path)

    def _load_buffer(self, index: int) -> bytes:
        uri = self.item("buffers", index).get("uri")
        return self._uri(str(uri)) if uri is not None else self._binary if index == 0 else b""

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Return an item of a list in the JSON description."""
        entries = self.json.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f"{kind} has no item {index}")
        entry: dict[str, Any] = entries[index]
        return entry

    def view(self, index: object) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.item("bufferViews", index)
        is_compressed = _MESHOPT in view.get("extensions", {})
        return self._decompressed(index) if is_compressed else self._slice(view)

    def _decompress(self, index: object) -> bytes:
        import meshopt  # noqa: PLC0415 - few files need it

        compressed = self.item("bufferViews", index)["extensions"][_MESHOPT]
        count, stride = int(compressed["count"]), int(compressed["byteStride"])
        self._allow(count * stride)
        mode, kind = str(compressed["mode"]), str(compressed.get("filter", "NONE"))
        data: NDArray[Any] = meshopt.decode_gltf_buffer(
            self._slice(compressed), count, stride, mode, kind
        )
        return data.tobytes()

    def _slice(self, view: dict[str, Any]) -> bytes:
        start, size = int(view.get("byteOffset", 0)), int(view["byteLength"])
        buffer = self._buffer(int(view.get("buffer", 0)))
        if start < 0 or size < 0 or start + size > len(buffer):
            raise ValueError("a buffer view is outside the file")
        return buffer[start : start + size]

    def attributes(self, primitive: dict[str, Any], names: Iterable[str]) -> dict[str, Doubles]:
        """Return the named attributes (V, components) of a primitive, and its "indices" (N, 1)."""
        accessors = {k: v for k, v in primitive["attributes"].items() if k in names}
        if "indices" in primitive:
            accessors["indices"] = primitive["indices"]
        decoded = {}
        if _DRACO in primitive.get("extensions", {}):
            compressed = primitive["extensions"][_DRACO]
            data = self.view(compressed["bufferView"])
            num_faces, num_points = read_mesh_size(data)
            if 3 * num_faces > MAX_COUNT:
                raise UserError(f"a mesh has {num_faces} triangles; reduce it to {MAX_COUNT // 3}")
            if num_points > MAX_COUNT:
                raise UserError(f"a mesh has {num_points} points; reduce it to {MAX_COUNT}")
            indices = primitive["attributes"].values()
            kinds = [self.item("accessors", index)["type"] for index in indices]
            num_values = 3 * num_faces + num_points * sum(_NUM_COMPONENTS[kind] for kind in kinds)
            self._allow(4 * num_values)
            try:
                mesh = decode_mesh(data, 4 * num_values)
            except MemoryError:
                raise UserError(
                    "a Draco mesh needs far more memory than its attributes; export it again"
                ) from None
            decoded["indices"] = np.asarray(mesh.faces, np.float64).reshape(-1, 1)
            for name in accessors.keys() & compressed["attributes"].keys():
                item = self.item("accessors", accessors[name])
                values = mesh.get_attribute_by_unique_id(compressed["attributes"][name])["data"]
                decoded[name] = _to_float(
                    values.astype(_COMPONENT_TYPES[item["componentType"]]), item
                )
        return {
            name: self.accessor(index) for name, index in accessors.items() if name not in decoded
        } | decoded

    def accessor(self, index: object) -> Doubles:
        """Return an accessor's values (N, components); normalized values are in [-1, 1]."""
        item = self.item("accessors", index)
        width, count = _NUM_COMPONENTS[item["type"]], int(item["count"])
        kind = np.dtype(_COMPONENT_TYPES[item["componentType"]])
        if not 0 <= count <= MAX_COUNT:
            raise ValueError(f"an accessor has {count} elements")
        values = np.zeros((count, width), kind)
        if "bufferView" in item:
            stride = int(self.item("bufferViews", item["bufferView"]).get("byteStride", 0))
            values = self._strided(
                item["bufferView"], int(item.get("byteOffset", 0)), (count, width), kind, stride
            ).copy()
        if "sparse" in item:
            sparse = item["sparse"]
            size = int(sparse["count"])
            indices, replacements = sparse["indices"], sparse["values"]
            rows = self._strided(
                indices["bufferView"],
                int(indices.get("byteOffset", 0)),
                (size, 1),
                np.dtype(_COMPONENT_TYPES[indices["componentType"]]),
            )
            if size and rows.max() >= count:
                raise ValueError("a sparse accessor has an index out of range")
            values[rows[:, 0]] = self._strided(
                replacements["bufferView"],
                int(replacements.get("byteOffset", 0)),
                (size, width),
                kind,
            )
        return _to_float(values, item)

    def image(self, texture: object) -> bytes:
        """Return the encoded image of a texture, or nothing if it is not in the file."""
        entry = self.item("textures", texture)
        extensions = entry.get("extensions", {}).values()
        # Most programs read only the plain source, so an extension may have any other format.
        sources = [item["source"] for item in (entry, *extensions) if "source" in item]
        source = next(iter(sources), None)
        if source is None:
            return b""
        image = self.item("images", source)
        if "bufferView" in image:
            return self.view(image["bufferView"])
        return self._uri(str(image["uri"])) if "uri" in image else b""

    def nodes(self) -> list[tuple[int, Doubles]]:
        """Return the nodes of the scene with their world matrices (4, 4), parents first.

        A file without scenes has one scene, with all nodes.
        """
        nodes, scenes = self.json.get("nodes", []), self.json.get("scenes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        scene = scenes[self.json.get("scene", 0)] if scenes else {}
        roots = scene.get("nodes", [node for node in range(len(nodes)) if node not in children])
        queue = [(int(root), np.eye(4)) for root in roots]
        worlds: dict[int, Doubles] = {}
        while queue:
            number, parent = queue.pop(0)
            node = self.item("nodes", number)
            if number in worlds or len(worlds) > MAX_NODES:
                raise ValueError("its nodes do not form a tree")
            worlds[number] = parent @ _local_matrix(node)
            queue += [(int(child), worlds[number]) for child in node.get("children", [])]
        return list(worlds.items())

    def _strided(
        self, view: object, start: int, shape: tuple[int, int], kind: np.dtype[Any], stride: int = 0
    ) -> NDArray[Any]:
        data = self.view(view)
        width = shape[1] * kind.itemsize
        stride = stride or width
        if (
            start < 0
            or stride < width
            or (shape[0] and start + stride * (shape[0] - 1) + width > len(data))
        ):
            raise ValueError("an accessor is larger than its buffer view")
        return np.ndarray(shape, kind, data, start, (stride, kind.itemsize))


def _to_float(values: NDArray[Any], accessor: dict[str, Any]) -> Doubles:
    """Return numbers of an accessor; normalized numbers are in [-1, 1]."""
    out = values.astype(np.float64)
    if accessor.get("normalized") and values.dtype.kind in "iu":
        out = np.maximum(out / np.iinfo(values.dtype).max, -1.0)
    if not np.isfinite(out).all():
        raise ValueError("a number is not finite")
    return out


def _local_matrix(node: dict[str, Any]) -> Doubles:
    """Return the matrix (4, 4) of a node relative to its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    rotation = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
