"""Messages are encoded to the stored bytes, and the stored bytes are decoded to the messages."""

from __future__ import annotations

import json
from pathlib import Path

import msgpack
import pytest

from kouxing.shared.wire.codec import decode, encode
from kouxing.shared.wire.message import VERSION, Message
from tests.samples import SAMPLES

pytestmark = pytest.mark.golden
FILE = Path(__file__).parents[2] / "proto" / "golden" / f"version{VERSION}.json"
STORED: dict[str, list[bytes]] = {
    kind: [bytes.fromhex(part) for part in parts]
    for kind, parts in json.loads(FILE.read_text(encoding="utf-8")).items()
}


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: message.kind)
def test_bytes_are_as_stored(message: Message) -> None:
    assert encode(message) == STORED[message.kind]
    assert decode(STORED[message.kind]) == message


def test_stores_one_message_of_every_kind() -> None:
    assert list(STORED) == [message.kind for message in SAMPLES]


def test_bodies_are_plain_msgpack_maps() -> None:
    for kind, (_, body) in STORED.items():
        assert msgpack.unpackb(body)["version"] == VERSION, kind
