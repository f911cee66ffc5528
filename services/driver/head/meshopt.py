"""Decodes buffer views that meshoptimizer compressed.

Source: Khronos EXT_meshopt_compression, appendix A (attributes, triangles, indices) and B
(filters). No package on PyPI has wheels for all platforms. The input is not trusted;
reading past its end is an error.
"""

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

_HEADERS = {"ATTRIBUTES": 0xA0, "TRIANGLES": 0xE1, "INDICES": 0xD1}
_MAX_STRIDE = 256
_OFFSET, _NEXT, _LAST, _NUM_RECENT = range(4)  # indices into the decoder's state for triangles


def decode_view(data: bytes, view: dict[str, Any]) -> bytes:
    """Return the bytes of a buffer view; ``view`` is the object of the extension.

    Raises ``ValueError`` if the data or the description is invalid or uses an unknown filter.
    """
    mode, count, stride = str(view["mode"]), int(view["count"]), int(view["byteStride"])
    if not data or data[0] != _HEADERS.get(mode) or not 0 < stride <= _MAX_STRIDE or count < 0:
        raise ValueError(f"compressed data with mode {mode} and stride {stride} is invalid")
    # zeros after the end replace most checks: no group and no number reads further
    padded = np.frombuffer(data + bytes(64), np.uint8)
    if mode == "ATTRIBUTES":
        out = np.zeros((count, stride), np.uint8)
        is_complete = _decode_attributes(
            padded, len(data) - max(32, stride), len(data) - stride, out
        )
        if not is_complete:
            raise ValueError("compressed data is cut off")
        return _apply_filter(out, str(view.get("filter", "NONE")))
    indices = np.zeros(count, np.uint32)
    decode, tail = (_decode_triangles, 16) if mode == "TRIANGLES" else (_decode_indices, 4)
    if not decode(padded, len(data) - tail, indices):
        raise ValueError("compressed data is cut off")
    return indices.astype("<u2" if stride == 2 else "<u4").tobytes()


def _apply_filter(out: Bytes, name: str) -> bytes:
    if name == "NONE":
        return out.tobytes()
    if name != "EXPONENTIAL" or out.shape[1] % 4:  # the others are for normals and rotations
        raise ValueError(f"compression filter {name} does not fit")
    numbers = out.view("<i4")
    floats: NDArray[np.float32] = np.ldexp((numbers << 8 >> 8).astype("<f4"), numbers >> 24)
    return floats.tobytes()


@numba.njit(cache=True)
def _decode_attributes(data: Bytes, end: int, tail: int, out: Bytes) -> bool:
    """Fill ``out`` (count, stride); return whether the data is long enough."""
    count, stride = out.shape
    if tail < 1:
        return False
    last = data[tail : tail + stride].copy()  # the element before the first one
    rows_per_block = min((8192 // stride) & ~15, 256)
    offset = 1
    for first in range(0, count, rows_per_block):
        num_rows = min(rows_per_block, count - first)
        num_groups = (num_rows + 15) // 16
        for column in range(stride):
            header = offset
            offset += (num_groups + 3) // 4
            value = last[column]
            for group in range(num_groups):
                if offset > end:
                    return False
                bits = (0, 2, 4, 8)[(data[header + group // 4] >> (group % 4 * 2)) & 3]
                packed = offset
                offset += 2 * bits
                escape = (1 << bits) - 1
                for k in range(16):
                    delta = 0
                    if bits:
                        position = k * bits
                        shift = 8 - bits - position % 8
                        delta = (int(data[packed + position // 8]) >> shift) & escape
                        if bits < 8 and delta == escape:
                            delta = int(data[offset])
                            offset += 1
                    row = group * 16 + k
                    if row < num_rows:
                        value = np.uint8(value + (delta >> 1 ^ -(delta & 1)))
                        out[first + row, column] = value
            last[column] = value
    return offset <= end


@numba.njit(cache=True)
def _decode_varint(data: Bytes, offset: int) -> tuple[np.int64, int]:
    """Return a LEB128 number and the offset after it."""
    value, shift = np.int64(0), 0
    while True:
        byte = np.int64(data[offset])
        offset += 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128 or shift > 28:
            return value, offset


@numba.njit(cache=True)
def _decode_indices(data: Bytes, end: int, out: NDArray[np.uint32]) -> bool:
    offset = 1
    last = np.zeros(2, np.int64)
    for i in range(len(out)):
        if offset >= end:
            return False
        value, offset = _decode_varint(data, offset)
        delta = value >> 1
        last[value & 1] += delta >> 1 ^ -(delta & 1)
        out[i] = last[value & 1] & 0xFFFFFFFF
    return offset <= end


@numba.njit(cache=True)
def _next_vertex(
    choice: int, data: Bytes, state: NDArray[np.int64], recent: NDArray[np.int64]
) -> np.int64:
    """Return a vertex: 0 a new one, 1 to 14 a recent one, 15 explicit, otherwise near the last."""
    if choice == 0:
        state[_NEXT] += 1
        return np.int64(state[_NEXT] - 1)
    if choice < 15:
        return np.int64(recent[(state[_NUM_RECENT] - choice) & 15])
    if choice == 15:
        value, state[_OFFSET] = _decode_varint(data, state[_OFFSET])
        state[_LAST] += value >> 1 ^ -(value & 1)
    else:
        state[_LAST] += choice - 17
    return np.int64(state[_LAST])


@numba.njit(cache=True)
def _decode_triangles(data: Bytes, end: int, out: NDArray[np.uint32]) -> bool:
    """Fill ``out`` (3 N,) and return whether the data is long enough.

    The data starts with codes and ends with a table of 16 codes.
    """
    num_triangles = len(out) // 3
    edges, num_edges = np.zeros((16, 2), np.int64), 0
    recent, state = np.zeros(16, np.int64), np.zeros(4, np.int64)
    corners, choices = np.zeros(3, np.int64), np.zeros(3, np.int64)
    state[_OFFSET] = 1 + num_triangles
    for triangle in range(num_triangles):
        if state[_OFFSET] > end:
            return False
        code = np.int64(data[1 + triangle])
        edge, low = code >> 4, code & 15
        if edge < 15:
            corners[:2] = edges[(num_edges - 1 - edge) & 15]
            choices[:] = low + (low > 0)
            if low >= 13:
                choices[:] = (16, 18, 15)[low - 13]
            first = 2
        else:
            codes = np.int64(data[end + low])
            if low >= 14:
                codes = np.int64(data[state[_OFFSET]])
                state[_OFFSET] += 1
                state[_NEXT] *= codes != 0
            choices[0], choices[1], choices[2] = 15 * (low == 15), codes >> 4, codes & 15
            first = 0
        for k in range(first, 3):
            corners[k] = _next_vertex(choices[k], data, state, recent)
        for k in range(first, 3):  # after all of them have been read
            if choices[k] == 0 or choices[k] >= 15:
                recent[state[_NUM_RECENT] & 15] = corners[k]
                state[_NUM_RECENT] += 1
        for start in range(first // 2, 3):  # the edge ba is new only without an earlier edge
            edges[num_edges & 15] = (corners[(start + 1) % 3], corners[start])
            num_edges += 1
        out[3 * triangle : 3 * triangle + 3] = corners & 0xFFFFFFFF
    return bool(state[_OFFSET] <= end)
