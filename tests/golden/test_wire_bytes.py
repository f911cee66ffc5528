"""Messages are encoded to the stored bytes, and the stored bytes are decoded to the messages."""

import msgpack
import pytest
from kouxing_client.messages import VERSION

from kouxing.shared.wire.codec import decode, encode
from kouxing.shared.wire.kinds import MESSAGES
from tests.samples import SAMPLES, STORED


@pytest.mark.parametrize("kind", MESSAGES)
def test_bytes_are_as_stored(kind: str) -> None:
    topic, body = STORED[kind]["topic"].encode(), bytes.fromhex(STORED[kind]["body"])
    assert [part.hex() for part in encode(SAMPLES[kind])] == [topic.hex(), body.hex()]
    assert decode([topic, body]) == SAMPLES[kind]
    assert msgpack.unpackb(body)["version"] == VERSION
