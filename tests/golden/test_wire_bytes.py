"""Messages written by this and every earlier build of the version can be read."""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import pytest

from shared.codec import decode, encode
from tests.samples import SAMPLES

pytestmark = pytest.mark.golden
GOLDEN = Path(__file__).parents[2] / "proto" / "golden" / "version1.json"
STORED: dict[str, list[str]] = json.loads(GOLDEN.read_text(encoding="utf-8"))


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: message.kind)
def test_bytes_are_as_stored_and_are_read_back(message) -> None:  # type: ignore[no-untyped-def]
    stored = [bytes.fromhex(part) for part in STORED[message.kind]]
    assert encode(message) == stored
    assert decode(stored) == message


def test_the_bodies_are_plain_msgpack_maps() -> None:
    for kind, (_, body) in STORED.items():
        fields = msgpack.unpackb(bytes.fromhex(body))
        assert fields["version"] == 1, kind
