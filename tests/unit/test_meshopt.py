"""Compressed buffer views; the bytes are from meshoptimizer's encoder."""

import numpy as np
import pytest

from kouxing.services.driver.head.meshopt import decode_view

ATTRIBUTES = (
    "a007004ade8d069ad13d56ea8112a6c53162ff000000f6751eb20a0002224444666888a8ac0000000000000a"
    "0eeeeeeeeeeeeeeeeeee00000000000000000000000000000000000000000000000000000000000000000000"
    "000000000003000000"
)
TRIANGLES = "e1fe1e100e100e100ece1e160e150e140effff0f0a611bfc06d204007687566778a9866589689801690000"
INDICES = "d1140e04911c04b1ef100400000000"
FLOATS = (
    "a001300000006801300000000f000130000000100130000000ff0130000000bc012000000001300000001000"
    "0000000000000000000000000000000000000000000000000800f400e0fff4"
)
GRID = [
    corner
    for a in (0, 1, 2, 3, 5, 6, 7, 8)
    for corner in (*((a, a + 1, a + 5) if a % 5 == 0 else (a + 5, a, a + 1)), a + 5, a + 1, a + 6)
]


@pytest.mark.parametrize(
    ("encoded", "view", "kind", "expected"),
    [
        (
            ATTRIBUTES,
            {"mode": "ATTRIBUTES", "count": 20, "byteStride": 8},
            "<u2",
            [n for k in range(20) for n in (37 * k * k, 7 * k, 3, 0)],
        ),
        (
            TRIANGLES,
            {"mode": "TRIANGLES", "count": 54, "byteStride": 4},
            "<u4",
            [*GRID, 0, 9, 14, 3, 300, 2],
        ),
        (
            INDICES,
            {"mode": "INDICES", "count": 7, "byteStride": 4},
            "<u4",
            [5, 1, 2, 900, 3, 70000, 4],
        ),
        (
            FLOATS,
            {"mode": "ATTRIBUTES", "count": 2, "byteStride": 8, "filter": "EXPONENTIAL"},
            "<f4",
            [0.5, -2, 3.25, 1000],
        ),
    ],
    ids=["attributes", "triangles", "indices", "floats"],
)
def test_decodes_each_mode_and_rejects_damage(
    encoded: str, view: dict[str, object], kind: str, expected: list[float]
) -> None:
    data = bytes.fromhex(encoded)
    assert np.frombuffer(decode_view(data, view), kind).tolist() == expected
    with pytest.raises(ValueError, match="cut off"):
        decode_view(data[: len(data) // 4], view)
    with pytest.raises(ValueError, match="invalid"):
        decode_view(b"\0" + data[1:], view)
    rng = np.random.default_rng(0)
    for place in rng.integers(1, len(data), 15):
        broken = bytearray(data)
        broken[place] ^= rng.integers(1, 256)
        try:
            assert len(decode_view(bytes(broken), view)) == len(expected) * int(kind[2])
        except ValueError as error:
            assert "cut off" in str(error)  # noqa: PT017
