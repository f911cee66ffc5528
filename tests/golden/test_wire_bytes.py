"""Stored messages are read for ever, and what is written now is what is stored."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import msgpack
import pytest

from kouxing.shared.wire.codec import BadMessage, decode, encode
from kouxing.shared.wire.message import VERSION, Message
from tests.samples import SAMPLES

pytestmark = pytest.mark.golden
FOLDER = Path(__file__).parents[2] / "proto" / "golden"
# The files are never written again: a later addition to a version gets a file of its own.
DIGESTS = {
    "version1.json": "1e1a1c42b3b98fbb2b622eaf0bb0d4f7774ea38f58e2ff5c0daeb109e9178c34",
    "version2.json": "db8042c5cd7e09ad90edf970880b4e7753139607a5156a73d0a48622def0374b",
    "version2-express.json": "9e8243549d328b69ec3077fce7157525af7ecd2dece06b3a58b4c454a5bd4821",
    "version2-amount.json": "442ab148cb675aec865dff988f7d0a8be1de931df33c48db68deaf43196e81f6",
    "version2-heartbeat.json": "6ff43c3df98604b937bb4f5c0917f6ece320505ca15292a4e75077d7c3c26aa4",
    "version2-progress.json": "0f497d631815a1fe745f5b5e5a0005170f03f8942de8f19bee013c3db37e508f",
    "version2-status.json": "76082bd28da61ec5ab45bf74abb2c610126af722c0af8ca6bcdbfd83f4e4442e",
    "version2-pitch.json": "31891c9db98db7a19deb2198869a4f42b05d2b41e1f0f7e885f2e82538d8b66a",
    "version2-voice.json": "1a748175ef62d82ae6c0be096aaaaf969ef9b9b309e68571e4dbaececb2d7289",
    "version2-keys.json": "9432071c81e53ca44db189787bb29affd77f3877cfb2fdb67a57f1ca721d6dbe",
    "version2-failover.json": "ef41439c5cb92622a377f96bd751c144db8b9fc950ce54bca0227f1eb7f578de",
    "version2-resume.json": "8e28a901814d98d5756a44f9586742ec5d99fe9132e2b011fb74b39ea3650e74",
    "version2-audio.json": "d30442ccf40c9d67b261ab9e4b0779ae035150c71484b62345180cb6a046139c",
    "version2-pages.json": "1f357c1fa65c5af61af8e85168ade64bb7c69083d3f66d4aa8eb08f7d5bf86ce",
    "version2-shapes.json": "991008823cc7b9721e95e913f8cf99bd7e0acd3f2655571676cd9f04f860f0a6",
    "version2-speech.json": "390cd4c46f5cfa02de1744893571dbef0cdfe015a732e5fe62a3e4c6bef2e202",
}


def stored_in(name: str) -> dict[str, list[bytes]]:
    """Return the two parts of each stored message by kind."""
    text = (FOLDER / name).read_text(encoding="utf-8")
    return {
        kind: [bytes.fromhex(part) for part in parts] for kind, parts in json.loads(text).items()
    }


VERSION_2 = [stored_in(name) for name in DIGESTS if name.startswith("version2")]
CURRENT = {kind: parts for stored in VERSION_2 for kind, parts in stored.items()}


def test_no_stored_file_was_written_again() -> None:
    digests = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in FOLDER.iterdir()
    }
    assert digests == DIGESTS


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: message.kind)
def test_bytes_are_as_stored_and_are_read_back(message: Message) -> None:
    assert encode(message) == CURRENT[message.kind]
    assert all(
        decode(stored[message.kind]) == message for stored in VERSION_2 if message.kind in stored
    )


def test_one_message_of_every_kind_is_stored() -> None:
    assert list(CURRENT) == [message.kind for message in SAMPLES]


@pytest.mark.parametrize(("kind", "parts"), stored_in("version1.json").items())
def test_messages_of_version_1_are_recognised_and_refused_by_name(
    kind: str, parts: list[bytes]
) -> None:
    with pytest.raises(BadMessage, match=f"'{kind}' is a message of protocol version 1") as caught:
        decode(parts)
    assert (caught.value.reason, caught.value.version) == ("version", 1)


@pytest.mark.parametrize(("name", "version"), [("version1.json", 1), ("version2.json", VERSION)])
def test_the_bodies_are_plain_msgpack_maps(name: str, version: int) -> None:
    for kind, (_, body) in stored_in(name).items():
        assert msgpack.unpackb(body)["version"] == version, kind
